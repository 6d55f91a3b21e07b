"""What the estimator says of a place: found, left, doubted or not to be felt; how sure it is."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.estimate import (
    SURE,
    UNMODELLED_M,
    Hypotheses,
    Status,
    Verdict,
    placed,
    status,
)
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.object_belief import SEARCHES
from taxeld.estimator.scans import REMEMBERED
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import Activation, Observation, ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld.proposals.analytic import Manifold
from tests.rig.pressed_box import TRUTH, World, box_side, estimator, settled
from tests.rig.scenes import Distance, box, disc, scene_of

ELSEWHERE = np.array([-0.1, 0.1, 2.0])
SHIFT = np.array([0.01, 0.0, 0.0])
SPREAD = 0.6  # of the gains of a rough skin: the model takes 0.17


def test_one_narrow_touch_is_not_yet_converged(box_model: ObservationModel) -> None:
    """A mode must be confirmed by a touch that could have refuted it."""
    world = World(box_model)
    subject = world.knowing()
    first = world.press(subject, 0.2)
    assert first.modes[0].weight > 0.9
    assert first.status is Status.AMBIGUOUS


def test_contacts_on_a_rough_skin_do_not_move_the_object(box_model: ObservationModel) -> None:
    """Together they may be of something else, but of no other place."""
    world = World(box_model)
    subject = world.knowing()
    rng = np.random.default_rng(1)
    doubted = 0
    for k in range(12):
        world.gain = np.exp(SPREAD * rng.standard_normal(len(box_model.layout)))
        estimate = world.press(subject, 0.9 * k)
        doubted += estimate.status is Status.INCONSISTENT
    assert doubted > 1
    assert subject.belief.metric.distance(estimate.map, TRUTH) < 0.01


def test_an_object_that_was_moved_is_missed_by_two_touches_and_then_found(
    box_model: ObservationModel,
) -> None:
    world, subject = settled(box_model)
    world.truth = ELSEWHERE
    for angle in (0.2, 1.3):
        estimate = world.press(subject, angle)
    assert estimate.status is Status.INCONSISTENT
    assert estimate.hypotheses.stands < 0.2
    estimate = world.find(subject)
    assert estimate.hypotheses.moved > 0.9
    assert subject.belief.metric.distance(estimate.map, world.truth) < 0.003


def test_an_object_that_stands_does_not_move_as_contacts_are_forgotten(
    box_model: ObservationModel,
) -> None:
    world = World(box_model)
    subject = world.knowing()
    estimates = [world.press(subject, 0.2 + 1.35 * k) for k in range(2 * REMEMBERED)]
    moved = np.array([estimate.hypotheses.moved for estimate in estimates])
    assert np.mean(moved[REMEMBERED:] < 0.5) > 0.8


@pytest.mark.parametrize("other", [disc(0.05), box(0.06, 0.06), box(0.02, 0.1)])
def test_another_object_is_told_and_never_taken_for_the_known_one(
    box_model: ObservationModel, skin: Layout, other: Distance
) -> None:
    touched = ObservationModel(scene_of(other, skin, symmetry=1), skin, box_model.depth_max_m)
    world = World(touched)
    subject = Estimator(box_model, Manifold(box_model), FilterConfig())
    for angle in (0.2, 1.3, 2.9, 4.5, 5.5, 0.7):
        estimate = world.press(subject, angle)
        assert estimate.status is not Status.CONVERGED
    assert estimate.hypotheses.other > 0.9
    assert estimate.status is Status.INCONSISTENT


def test_one_touch_of_something_else_does_not_move_the_object(box_model: ObservationModel) -> None:
    world, subject = settled(box_model)
    world.truth = ELSEWHERE
    world.press(subject, 0.2)
    world.truth = TRUTH
    estimate = world.find(subject)
    assert subject.belief.metric.distance(estimate.map, TRUTH) < 0.003


def test_after_a_contact_that_nothing_explains_silence_ends_no_doubt(
    box_model: ObservationModel,
) -> None:
    """Where silence is expected it explains nothing."""
    world, subject = settled(box_model)
    world.truth = ELSEWHERE
    for angle in (0.2, 1.3):
        world.press(subject, angle)
    away = box_side(box_model, 1.3, -0.02)
    for _ in range(40):
        assert world.feel(subject, away).status is Status.INCONSISTENT


def test_an_object_taken_away_is_missed(box_model: ObservationModel) -> None:
    """Silence on two sides where all that is known expects a touch."""
    world, subject = settled(box_model)
    silent = Activation(world.t, np.zeros(32), np.ones(32, dtype=bool))
    for k, angle in enumerate((0.2, 3.6), 1):
        sensor = se2.compose(TRUTH, box_side(box_model, angle, 0.004))
        estimate = subject.on_scan(replace(silent, t=world.t + k), sensor)
        assert estimate.p < SURE
    assert estimate.p < 0.01
    assert estimate.status is Status.INCONSISTENT


def test_a_wide_belief_has_more_particles(box_model: ObservationModel) -> None:
    belief = estimator(box_model).belief
    wide = belief._size(belief.particles)
    belief.particles.pose[:] = TRUTH
    assert wide > 1.5 * belief._size(belief.particles)


@pytest.mark.parametrize("all_dead", [True, False])
def test_where_only_dead_taxels_would_feel_it_is_blind_until_a_scan_tells_more(
    box_model: ObservationModel, *, all_dead: bool
) -> None:
    world, subject = settled(box_model)
    sensor = se2.compose(TRUTH, box_side(box_model, 0.2, 0.004))
    pressed = box_model.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0] > 0.0
    scan = Activation(world.t + 1.0, np.zeros(32), ~(pressed | all_dead))
    # a scan that cannot be used, as the sensor jumps, says nothing new
    for t, far in ((0.0, 0.0), (0.05, 5.0), (0.1, 1e9), (0.15, 0.0)):
        at = sensor + np.array([far, 0.0, 0.0])
        assert subject.on_scan(replace(scan, t=scan.t + t), at).status is Status.BLIND


def test_a_pushed_object_of_which_the_place_was_known_is_found_by_fewer_contacts(
    box_model: ObservationModel,
) -> None:
    """What the contacts before the push told is still known, as a prior."""
    found = []
    for known in (True, False):
        world, subject = settled(box_model)
        belief = subject.belief
        if not known:
            subject.reset()
        else:
            belief.push = lambda _, __, pose, *___: (pose + SHIFT, np.full(len(pose), 0.01))
            nothing = Observation(np.zeros(3), np.zeros(32), np.ones(32, dtype=np.bool_))
            belief.follow(nothing, nothing)
            assert not len(belief.memory)
            world.truth = TRUTH + SHIFT
        for angle in (0.2, 2.9):
            estimate = world.press(subject, angle)
        found.append(estimate.status)
    assert found[0] is Status.CONVERGED
    assert found[1] is not Status.CONVERGED


def test_no_belief_is_sure_before_a_search_has_left_it_in_place(
    box_model: ObservationModel,
) -> None:
    world = World(box_model)
    subject = world.knowing()
    subject.on_scan = partial(subject.on_scan, thinks=False)  # type: ignore[method-assign]
    for k in range(20):
        world.press(subject, 0.2 + 1.1 * k)
        if subject.has_thought:
            break
    assert 0.9 < subject.estimate.p < SURE
    assert sum(subject.think() for _ in range(20)) <= SEARCHES
    assert subject.estimate.p >= SURE


NARROW = np.array([0.001, 0.001, 0.01])
STANDING = Hypotheses()


def verdict(
    model: ObservationModel,
    apart_m: float = 0.1,
    share: float = 0.0,
    hypotheses: Hypotheses = STANDING,
    here: float = 1.0,
    **keys: float,
) -> Verdict:
    """Of a narrow belief, a share of which is elsewhere."""
    poses = around(1000)
    poses[: round(1000 * share), 0] += apart_m
    belief = pf.equal(poses)
    config = FilterConfig(**keys)  # type: ignore[arg-type]
    return Verdict(placed(belief, PoseMetric(model.scene), config), here, hypotheses)


def around(n: int) -> Poses:
    return NARROW * np.random.default_rng(0).standard_normal((n, 3)).clip(-2.0, 2.0)


@pytest.mark.parametrize(("share", "here"), [(0.0, 1.0), (0.25, 1.0), (0.4, 0.5)])
def test_p_is_the_weight_near_the_best_pose(
    box_model: ObservationModel, share: float, here: float
) -> None:
    p = verdict(box_model, share=share, here=here).p
    assert p == pytest.approx(here * (1.0 - share), abs=0.005)


def test_equivalent_poses_are_near_each_other(box_model: ObservationModel) -> None:
    assert box_model.scene.symmetry == 2
    poses = around(1000)
    poses[::2, 2] += np.pi
    config, metric = FilterConfig(), PoseMetric(box_model.scene)
    found = placed(pf.equal(poses), metric, config)
    assert found.within > 0.995
    assert found.radius_m < 0.01


def test_a_little_more_room_makes_a_belief_a_little_surer(
    box_model: ObservationModel,
) -> None:
    """Robot, foam and shape err as well, so no particle is within it or not."""
    found = [verdict(box_model, 0.01, 0.4, within_m=0.003 + 2e-4 * k).p for k in range(21)]
    assert (np.diff(found) > 0.0).all()
    assert np.diff(found).max() < 0.1
    assert found[-1] - found[0] > 0.4


def test_the_radius_holds_every_particle_and_grows_as_less_is_risked(
    box_model: ObservationModel,
) -> None:
    risks = (0.5, 0.1, 1e-3, 1e-6)
    for share in (0.0, 0.01):
        radii = [verdict(box_model, share=share, risk=risk).place.radius_m for risk in risks]
        assert (np.diff(radii) > 0.0).all()
        assert min(radii) > UNMODELLED_M
        assert min(radii) > 0.09 * (share > 0.0)


STANDS, MOVED, OTHER = (
    Hypotheses(*each) for each in ((0.6, 0.3, 0.1), (0.3, 0.5, 0.2), (0.2, 0.3, 0.5))
)


@pytest.mark.parametrize(
    ("hypotheses", "p", "expected"),
    [
        pytest.param(STANDS, 0.99, Status.CONVERGED, id="sure"),
        pytest.param(STANDS, 0.98, Status.AMBIGUOUS, id="not sure"),
        pytest.param(MOVED, 0.99, Status.CONVERGED, id="found where it was put"),
        pytest.param(MOVED, 0.98, Status.INCONSISTENT, id="put elsewhere"),
        pytest.param(OTHER, 0.2, Status.INCONSISTENT, id="something else"),
    ],
)
def test_status(
    box_model: ObservationModel, hypotheses: Hypotheses, p: float, expected: Status
) -> None:
    made = verdict(box_model, hypotheses=hypotheses)
    made = Verdict(replace(made.place, within=p), 1.0, hypotheses)
    assert status(made, 3) is expected
    assert status(made, 0) is Status.SEARCHING
    assert status(made, 3, blind=True) is Status.BLIND


def test_while_no_place_has_much_weight_it_searches(box_model: ObservationModel) -> None:
    poses = np.random.default_rng(0).uniform(-0.5, 0.5, (1000, 3))
    belief = pf.equal(poses)
    made = Verdict(placed(belief, PoseMetric(box_model.scene), FilterConfig()), 1.0, STANDS)
    assert status(made, 2) is Status.SEARCHING
