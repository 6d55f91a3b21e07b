"""SE(2), layouts, observation and contact synthesis against closed forms; poses up to symmetry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.estimator.scans import Reader
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric, add_m

from ..rig.memories import memory_of, plus
from ..rig.scenes import DEPTH_MAX_M, box, scene_of

pose = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-7, 7)).map(np.array)


@given(pose, pose)
def test_a_pose_composed_with_its_inverse_is_the_identity(a: np.ndarray, b: np.ndarray) -> None:
    assert np.allclose(se2.compose(a, se2.inverse(a)), 0.0, atol=1e-9)
    points = np.array([[0.3, -0.2], [1.0, 2.0]])
    together = se2.apply(se2.compose(a, b), points)
    assert np.allclose(together, se2.apply(a, se2.apply(b, points)))


@given(st.floats(-3e3, 3e3))
def test_an_angle_is_wrapped_to_half_a_turn_on_either_side(angle: float) -> None:
    wrapped = se2.wrap(np.float64(angle))
    assert abs(wrapped) <= np.pi + 1e-12
    assert abs((angle - wrapped + np.pi) % (2 * np.pi) - np.pi) < 1e-9


def test_turning_the_touch_permutes_the_taxels(box_model: ObservationModel, skin: Layout) -> None:
    rng = np.random.default_rng(0)
    poses = contacts.synthesise(box_model.scene, 0.04, DEPTH_MAX_M, 50, rng).pose
    h = box_model.activation(poses)
    assert (h.max(axis=1) > 0.1).any()
    assert len(skin.turns) == 16
    for k, turn in enumerate(skin.turns):
        back = np.array([0.0, 0.0, -2 * np.pi * k / 16])
        assert np.allclose(box_model.activation(se2.compose(back, poses)), h[:, turn], atol=0.03)


@given(st.floats(0.0, 6.28), st.floats(0.0, 0.005))
def test_a_disc_pressed_deep_reads_its_depth(
    disc_model: ObservationModel, angle: float, depth: float
) -> None:
    """On a round object the taxel's depth has a closed form: R_o − |q⁻¹ p|."""
    gap = 0.09 - depth
    q = np.array([[gap * np.cos(angle), gap * np.sin(angle), 1.0]])
    p = disc_model.layout.position_m[:, :2]
    expected = np.clip((0.05 - np.linalg.norm(p - q[0, :2], axis=1)) / DEPTH_MAX_M, 0, 1)
    assert np.allclose(disc_model.activation(q)[0], expected, atol=0.01)


def test_touches_are_explained_as_the_dense_model_says(box_model: ObservationModel) -> None:
    rng = np.random.default_rng(0)
    noise = Noise()
    poses = contacts.synthesise(box_model.scene, 0.04, DEPTH_MAX_M, 700, rng).pose
    memory, dense = memory_of(box_model, noise), []
    for sensor in ([0.0, 0.0, 0.0], [0.01, -0.02, 1.0], [0.3, 0.0, 0.0]):
        seen = se2.compose(se2.inverse(np.array(sensor)), poses)
        h = box_model.activation(seen)
        z, live = noise.draw(h[3], rng), rng.random(h.shape[1]) < 0.8
        memory = plus(memory, Observation(np.array(sensor), z, live))
        dense.append(noise.log_density(z, h) @ live.astype(float))
    assert np.allclose(memory.explain(poses), np.array(dense).T, atol=0.01)
    assert np.allclose(memory.explain_next(memory.scans[-1], poses), dense[-1], atol=0.01)
    memory = memory.only(np.array([False, True, True]))
    assert np.allclose(memory.explain(poses), np.array(dense).T[:, 1:], atol=0.01)
    assert memory.explain(poses[:0]).shape == (0, 2)


def test_silences_of_other_taxels_or_floors_tell_other_things(box_model: ObservationModel) -> None:
    """Whatever silence came before."""
    rng = np.random.default_rng(0)
    poses = contacts.synthesise(box_model.scene, 0.04, DEPTH_MAX_M, 100, rng).pose
    taxels, nothing = len(box_model.layout), memory_of(box_model, Noise())
    reader = Reader(box_model.links, Noise())
    all_live, half = np.ones(taxels, dtype=bool), np.arange(taxels) % 2 == 0
    for live, floor, residue in (
        (all_live, 0.02, 0.0),
        (half, 0.02, 0.0),
        (half, 0.1, 0.0),
        (half, 0.1, 0.05),
        (all_live, np.where(half, 0.1, 0.02), 0.0),
        (all_live, 0.02, 0.0),
    ):
        silence = Observation(np.zeros(3), np.zeros(taxels), live, floor, residue)
        one, alone = nothing.plus(reader.read(silence)), plus(nothing, silence)
        assert np.array_equal(one.explain(poses), alone.explain(poses))
        assert one.anything[0] == alone.anything[0]


def test_a_dead_taxel_says_nothing(box_model: ObservationModel) -> None:
    dead = Observation(np.zeros(3), np.zeros(32), np.zeros(32, dtype=bool))
    memory = plus(memory_of(box_model, Noise()), dead)
    poses = np.array([[0.072, 0.0, 0.0], [0.09, 0.0, 0.0]])
    assert np.array_equal(memory.explain(poses), np.zeros((2, 1)))


@pytest.mark.parametrize(("z", "h"), [(1.0, 0.0), (0.5, 0.0), (0.0, 1.0)])
def test_one_wrong_taxel_costs_a_bounded_amount(z: float, h: float) -> None:
    worst = Noise(outliers=0.01).log_density(np.array([z]), np.array([h]))
    assert np.isclose(worst, np.log(0.01 / 3.0), atol=0.1)


def test_densities_of_readings_sum_to_one_and_are_as_they_are_drawn() -> None:
    noise, z = Noise(outliers=0.0), np.linspace(FLOOR, 1.0, 100_001)[1:-1]
    for h in (0.0, 0.02, 0.3, 1.0):
        density = np.exp(noise.log_density(np.array([0.0, 1.0, *z]), np.full(1, h)))
        assert np.isclose(density[0] + density[1] + np.trapezoid(density[2:], z), 1.0, atol=1e-3)
    drawn = noise.draw(np.full((100_000, 4), [0.0, 0.06, 0.3, 1.0]), np.random.default_rng(0))
    for z in (0.0, 1.0):
        likely = np.exp(noise.log_density(np.full(4, z), np.array([0.0, 0.06, 0.3, 1.0])))
        assert np.mean(drawn == z, axis=0) == pytest.approx(likely, abs=0.006)


def test_a_higher_floor_makes_silence_say_less() -> None:
    noise, h = Noise(), np.array([0.0, 0.05, 0.1, 0.2])
    low, high = (noise.log_density(np.zeros(1), h, floor) for floor in (0.01, 0.15))
    assert low[0] - low[2] > 5.0
    assert high[0] - high[2] < 0.2 < high[0] - high[3]
    assert noise.log_density(np.array([0.1]), h, residue=0.1)[0] > (
        noise.log_density(np.array([0.1]), h)[0] + 3.0
    )


def test_projected_contacts_press_as_deep_as_asked(disc_model: ObservationModel) -> None:
    rng = np.random.default_rng(1)
    made = contacts.synthesise(disc_model.scene, 0.04, DEPTH_MAX_M, 2000, rng)
    gap = np.hypot(made.pose[:, 0], made.pose[:, 1]) - 0.09
    assert len(made.pose) + made.dropped == 2000
    assert made.dropped < 20  # the disc's middle alone has no direction
    assert np.allclose(gap, -made.depth_m, atol=contacts.RESIDUAL_MAX_M + 1e-4)


poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3)).map(np.array)


@pytest.mark.parametrize("order", [0, 1, 2, 5])
@given(pose=poses, k=st.integers(0, 9))
def test_equivalent_poses_are_no_distance_apart(
    skin: Layout, order: int, pose: np.ndarray, k: int
) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=order)
    metric = PoseMetric(scene)
    turn = 2.0 * np.pi * k / (order or 36)
    other = se2.compose(pose, se2.rotation_about(scene.centre, turn))
    assert np.isclose(metric.distance(pose, other), 0.0, atol=1e-6)
    assert add_m(scene, other, pose)[1] < 1e-6


def test_distance_is_the_surface_displacement_to_first_order(skin: Layout) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=1)
    a, b = np.zeros(3), np.array([0.003, -0.004, 0.0])
    assert np.isclose(PoseMetric(scene).distance(a, b), 0.005)
    turn = np.array([0.0, 0.0, 0.01])
    assert np.isclose(PoseMetric(scene).distance(a, turn), 0.05 * 0.01)
    assert np.isclose(add_m(scene, turn, a)[0], 0.05 * 0.01, rtol=1e-3)


def test_plain_add_sees_what_the_symmetric_one_forgives(skin: Layout) -> None:
    scene = scene_of(box(0.03, 0.06), skin, symmetry=2)
    plain, symmetric = add_m(scene, np.array([0.0, 0.0, np.pi]), np.zeros(3))
    assert np.isclose(plain, 0.1)
    assert np.isclose(symmetric, 0.0, atol=1e-9)


def test_the_mean_of_half_turned_twins_is_either_and_not_between(skin: Layout) -> None:
    metric = PoseMetric(scene_of(box(0.03, 0.06), skin, symmetry=2))
    twins = np.array([[0.0, 0.0, 0.1], [0.002, 0.0, 0.1 - np.pi]])
    mean, cov = metric.mean(twins, np.ones(2), twins[0])
    assert np.allclose(mean, [0.001, 0.0, 0.1])
    assert np.allclose(np.diag(cov), [1e-6, 0.0, 0.0], atol=1e-12)


def test_modes_merge_equivalents_and_order_by_weight(skin: Layout) -> None:
    metric = PoseMetric(scene_of(box(0.03, 0.06), skin, symmetry=2))
    cloud = np.array([[0.0, 0, 0], [0.001, 0, np.pi - 0.01], [0.3, 0, 0.0], [0.3, 0.2, 1.0]])
    modes = metric.modes(cloud, np.array([0.3, 0.3, 0.25, 0.15]), 0.02, most=5, candidates=64)
    assert [round(mode.weight, 2) for mode in modes] == [0.6, 0.25, 0.15]
    assert sorted(modes[0].members) == [0, 1]


def test_no_mode_is_passed_over_for_where_it_stands_in_the_array(
    box_model: ObservationModel,
) -> None:
    """Of many equal particles the last are as good as the first."""
    poses = np.zeros((400, 3))
    poses[300:, 0] = 0.3
    weight = np.full(400, 1 / 400)
    for order in (slice(None), slice(None, None, -1)):
        found = PoseMetric(box_model.scene).modes(poses[order], weight, 0.02, 5, 64)
        assert [round(mode.weight, 6) for mode in found] == [0.75, 0.25]
