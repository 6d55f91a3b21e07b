"""The layout value: numbering, digest, turns; generated layouts; the cylinder fit; the command."""

import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.commands.layout import pitch_m, tilted
from taxeld.estimator.scans import Reader
from taxeld.layout import fit
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric, add_m
from taxeld_protocol.modules import wired
from tests.rig.commands import printed, refuses

from ..rig.memories import memory_of, plus
from ..rig.scenes import DEPTH_MAX_M, box, scene_of

DEFAULT = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
WRAP = "wrap:modules=12,radius_m=0.04,rows=2"


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def arc(degrees: float, radius_m: float = 0.07, rows: int = 8, columns: int = 20):
    """Positions and outward normals of a regular patch about z, centred on angle 0."""
    angle = np.radians(np.tile(np.linspace(-degrees / 2, degrees / 2, columns), rows))
    height = np.repeat(np.arange(rows) * 0.008, columns)
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    return radius_m * normal + height[:, None] * [0.0, 0.0, 1.0], normal


def test_a_cylinders_taxels_go_row_by_row_from_below_and_counter_clockwise():
    skin = layouts.load(DEFAULT)
    assert (skin.digest, skin.name) == ("cc915a300678428f", DEFAULT), "bundles refer to it"
    row, angle = np.divmod(np.arange(80), 16) * np.array([[1.0], [2 * math.pi / 16]])
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    place = 0.04 * normal + (row[:, None] - 2) * [0.0, 0.0, 0.015]
    np.testing.assert_allclose(skin.position_m, place, atol=1e-15)
    np.testing.assert_allclose(skin.normal, normal, atol=1e-15)
    assert (skin.frame == np.eye(4)).all()


@pytest.mark.parametrize("sui", [1, 9])
def test_uid_is_module_and_name_ten_taxels_a_module_and_changes_no_bundle(sui):
    spec = "cylinder:rows=1,columns=23,radius_m=0.04,pitch_m=0.015"
    skin = layouts.load(f"{spec},sui={sui}")
    assert skin.uid.tolist() == [((i // 10 + sui) << 4) | (i % 10 + 1) for i in range(23)]
    modules = [(m.sui, m.mask) for m in wired(skin.uid.tolist())]
    assert modules == [(sui, 0x7FF), (sui + 1, 0x7FF), (sui + 2, 0xF)]
    assert skin.digest == layouts.load(spec).digest


TRIANGLE_MM = [(12, 5.657), (4, 5.657), (-4, 5.657), (-12, 5.657), (-8, 0), (-4, -5.657),
               (0, -11.314), (4, -5.657), (8, 0), (0, 0)]  # fmt: skip


def test_a_wraps_triangle_is_the_measured_one_and_the_next_stands_on_its_head():
    skin = layouts.load(WRAP)
    x = np.arctan2(skin.position_m[:10, 1], skin.position_m[:10, 0]) * 40.0
    z = skin.position_m[:, 2].reshape(2, 12, 10) * 1e3
    relative = np.column_stack([x - x[9], z[0, 0] - z[0, 0, 9]])
    np.testing.assert_allclose(relative, TRIANGLE_MM, atol=1e-9)
    up = z - z[:, :, 9:]
    heads = [up[0, 1], up[1, 0], -up[0, 2]]
    np.testing.assert_allclose(heads, np.tile(-up[0, 0], (3, 1)), atol=1e-12)
    assert skin.uid.tolist() == [s << 4 | name for s in range(1, 25) for name in range(1, 11)]


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_wraps_taxels_keep_their_distance_and_are_centred(rows):
    skin = layouts.load(f"wrap:modules=22,radius_m=0.0701,rows={rows}")
    assert skin.position_m[:, 2].min() == pytest.approx(-skin.position_m[:, 2].max())
    assert pitch_m(skin) == pytest.approx(0.006928, abs=5e-5)
    gap = np.linalg.norm(skin.position_m[:, None] - skin.position_m, axis=-1)
    assert (gap + np.eye(len(skin))).min() > 0.0065


@pytest.mark.parametrize(
    ("spec", "order"),
    [
        (DEFAULT, 16),
        (WRAP, 6),
        ("cylinder:rows=31,columns=80,radius_m=0.1,pitch_m=0.01", 80),  # a full hub
    ],
)
def test_a_turned_reading_is_the_reading_of_the_turned_touch(spec, order):
    skin = layouts.load(spec)
    assert skin.turns.shape == (order, len(skin))
    for k, turn in enumerate(skin.turns):
        there = turned(skin.position_m, 2 * math.pi * k / order)
        np.testing.assert_allclose(skin.position_m[turn], there, atol=1e-12)
    for p, k in zip(skin.position_m, skin.sector, strict=True):
        x, y, _ = turned(p, -2 * math.pi * k / order)
        assert abs(math.atan2(y, x)) <= math.pi / order + 1e-9


def test_a_taxel_out_of_place_or_two_at_one_place_break_the_symmetry():
    skin = layouts.load(DEFAULT)
    moved = skin.position_m.copy()
    moved[7, 2] += 0.001
    for position in (moved, skin.position_m[np.zeros(80, int)]):
        bent = Layout("bent", skin.uid, position, skin.normal, skin.radius_m)
        assert len(bent.turns) == 1
        assert not bent.sector.any()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("", "no known layout"),
        ("sphere:rows=1", "no known layout"),
        ("ur.jsn", "ur.jsn: unreadable (No such file"),
        (__file__, "no known layout"),
        ("cylinder", "no known layout"),
        ("cylinder:", "unknown key; known: rows, columns, radius_m, pitch_m, sui"),
        ("cylinder:rows=5", "columns: is required; use 'cylinder:rows=5,columns=16,rad"),
        ("cylinder:rows=5,row=6", "row: unknown key; did you mean rows?"),
        (DEFAULT.replace("rows=5", "rows=five"), "rows: must be an integer, not 'five'"),
        (DEFAULT.replace("rows=5", "rows=0"), "rows: must be 1..2480, not 0"),
        (DEFAULT.replace("rows=5", "rows=999"), "rows × columns must be 1..2480"),
        (DEFAULT.replace("0.04", "nan"), "radius_m: must be a number, not nan"),
        (DEFAULT.replace("0.015", "-1"), "pitch_m: must be 1e-06..10, not -1"),
        ("wrap:modules=11,radius_m=0.1", "modules: must be even, as they alternate, not 11"),
        ("wrap:modules=12,radius_m=0.03", "radius_m: must be at least 0.0382 for 12 modules"),
        ("wrap:modules=248,radius_m=2,rows=2", "modules × rows: must be at most 248"),
        ("nowhere/skin", "nowhere/skin: unreadable (No such file"),
        ("x" * 5000 + ".json", "unreadable"),
        ("\0.txt", ""),
    ],
)
def test_text_that_is_no_layout_is_one_line_with_the_cure(spec, words):
    refuses(rf"^skin\.layout: [^\n]*{re.escape(words)}[^\n]*$", layouts.load, spec)


def test_a_full_turn_keeps_the_files_own_axis_as_angle_0():
    position, normal = arc(360.0 * 19 / 20)
    found = fit.cylinder(position, normal)
    np.testing.assert_allclose(found.frame[0, :3], [1.0, 0.0, 0.0], atol=1e-9)
    cycled = fit.cylinder(np.roll(position, 1, axis=1), np.roll(normal, 1, axis=1))
    np.testing.assert_allclose(cycled.frame[:3, :3] @ np.eye(3)[:, [1, 2, 0]], np.eye(3), atol=1e-9)


def test_a_fit_of_half_a_circle_with_noise_does_not_shrink():
    position, normal = arc(180.0)
    rng = np.random.default_rng(0)
    found = [
        fit.cylinder(position + off * normal, normal).radius_m
        for off in 0.003 * rng.standard_normal((50, len(position), 1))
    ]
    assert np.mean(found) == pytest.approx(0.07, abs=0.0005)


@pytest.mark.parametrize("what", ["flat", "point", "line", "blob", "dome"])
def test_a_fit_says_so_where_there_is_no_cylinder(what):
    position, normal = arc(180.0)
    rng = np.random.default_rng(0)
    up = np.abs(rng.standard_normal(normal.shape))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    position, normal = {
        "flat": (position * [0, 1, 1], np.tile([1.0, 0.0, 0.0], (len(normal), 1))),
        "point": (0.0 * position, normal),
        "line": (position * [0.0, 1.0, 0.0], normal),
        "blob": (0.05 * rng.standard_normal(position.shape), normal),
        "dome": (0.05 * up, up),
    }[what]
    found = fit.cylinder(position, normal)
    assert (found.radius_m, bool(found.why_none)) == (math.inf, True)
    assert np.isfinite(found.frame).all()


def test_pitch_leaves_out_taxels_at_the_same_place_and_tilted_normals_are_counted():
    position, normal = arc(180.0)
    for i, angle in ((0, 35.0), (1, 25.0)):
        normal[i] = turned(normal[i], math.radians(angle))
    normal[2] = 0.0, 0.0, 1.0
    twice = np.repeat(np.arange(len(normal)), 2)
    skin = Layout("pairs", twice, position[twice], normal[twice], 0.07)
    assert pitch_m(skin) == pytest.approx(0.008)
    assert tilted(skin) == 4


def test_the_command_prints_every_fact():
    text, facts = (
        printed("layout", DEFAULT),
        (
            *("80 in 8 modules", "0 missing, 0 cut, 0 duplicate", "metres", "40.0 mm", "360.0°"),
            *("60.0 mm", "15.00 mm", "order 16", "cc915a300678428f"),
        ),
    )
    assert [fact for fact in facts if fact not in text] == []


pose = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-7, 7)).map(np.array)


@given(pose, pose)
def test_a_pose_composed_with_its_inverse_is_the_identity(a: np.ndarray, b: np.ndarray) -> None:
    assert np.allclose(se2.compose(a, se2.inverse(a)), 0.0, atol=1e-9)
    points = np.array([[0.3, -0.2], [1.0, 2.0]])
    assert np.allclose(se2.apply(se2.compose(a, b), points), se2.apply(a, se2.apply(b, points)))


@given(st.floats(-3e3, 3e3))
def test_an_angle_is_wrapped_to_half_a_turn_on_either_side(angle: float) -> None:
    wrapped = se2.wrap(np.float64(angle))
    assert abs(wrapped) <= np.pi + 1e-12
    assert abs((angle - wrapped + np.pi) % (2 * np.pi) - np.pi) < 1e-9


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
        h = box_model.activation(se2.compose(se2.inverse(np.array(sensor)), poses))
        z, live = noise.draw(h[3], rng), rng.random(h.shape[1]) < 0.8
        memory = plus(memory, Observation(np.array(sensor), z, live))
        dense.append(noise.log_density(z, h) @ live.astype(float))
    assert np.allclose(memory.explain(poses).scans, np.array(dense).T, atol=0.01)
    assert np.allclose(memory.explain_newest(poses)[:, 0], dense[-1], atol=0.01)
    memory = memory.only(np.array([False, True, True]))
    assert np.allclose(memory.explain(poses).scans, np.array(dense).T[:, 1:], atol=0.01)
    assert memory.explain(poses[:0]).scans.shape == (0, 2)


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
        assert np.array_equal(one.explain(poses).scans, alone.explain(poses).scans)
        assert one.background[0] == alone.background[0]


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
