"""What the estimator says of a place: found, left, doubted, or not to be felt."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import REVISITS, Mixture
from taxeld.model import se2
from taxeld.model.activation import Activation
from taxeld.model.observation import Observation, ObservationModel
from tests.rig.pressed_box import TRUTH, Knowing, World, approach, box_side, estimator, settled

SPREAD = 0.6  # of the gains of a rough skin: the model takes 0.17


def test_one_narrow_touch_is_not_yet_converged(box_model: ObservationModel) -> None:
    """A mode must be confirmed by a touch that could have refuted it."""
    world = World(box_model)
    subject = Estimator(box_model, Knowing(world), FilterConfig())
    first = world.press(subject, 0.2)
    assert first.modes[0].weight > 0.9
    assert first.status is Status.AMBIGUOUS


def test_contacts_on_a_rough_skin_are_not_dropped_for_the_last_two(
    box_model: ObservationModel,
) -> None:
    """All together they deviate more than usual, though each alone does not. The last two, which
    agree with more poses, are explained no better by another."""
    world = World(box_model)
    subject = Estimator(box_model, Knowing(world), FilterConfig())
    rng = np.random.default_rng(1)
    doubted = 0
    for k in range(12):
        world.gain = np.exp(SPREAD * rng.standard_normal(len(box_model.layout)))
        estimate = world.press(subject, 0.9 * k)
        doubted += estimate.status is Status.INCONSISTENT
    assert doubted > 1
    assert subject.counters.forgotten == 0
    assert subject.rule.metric.distance(estimate.map, TRUTH) < 0.005


def test_an_object_that_was_moved_is_inconsistent_and_then_found(
    box_model: ObservationModel,
) -> None:
    world, subject = settled(box_model)
    world.truth = np.array([-0.1, 0.1, 2.0])
    assert world.press(subject, 0.2).status is Status.INCONSISTENT
    assert subject.counters.forgotten == 0
    for angle in (1.3, 2.9, 4.5):
        estimate = world.press(subject, angle)
    assert subject.counters.forgotten == 1
    assert estimate.status is Status.CONVERGED
    assert subject.rule.metric.distance(estimate.map, world.truth) < 0.003


def test_one_touch_of_something_else_does_not_move_the_object(box_model: ObservationModel) -> None:
    world, subject = settled(box_model)
    world.truth = np.array([-0.1, 0.1, 2.0])
    assert world.press(subject, 0.2).status is Status.INCONSISTENT
    world.truth = TRUTH
    estimate = world.press(subject, 3.6)
    assert subject.counters.forgotten == 0
    assert subject.rule.metric.distance(estimate.map, TRUTH) < 0.003
    assert estimate.status is not Status.INCONSISTENT


def test_a_contact_that_nothing_explains_is_doubted_until_another_is_explained(
    box_model: ObservationModel,
) -> None:
    """Not only while it is held: silence after it, where silence is expected, explains nothing."""
    world, subject = settled(box_model)
    world.truth = np.array([-0.1, 0.1, 2.0])
    world.press(subject, 0.2)
    away = box_side(box_model, 0.2, -0.02)
    for _ in range(40):
        assert world.feel(subject, away).status is Status.INCONSISTENT
    world.truth = TRUTH
    for angle in (3.6, 0.2, 5.0):
        world.press(subject, angle)
    assert world.feel(subject, box_side(box_model, 5.0, -0.02)).status is Status.CONVERGED


def test_an_object_taken_away_is_missed(box_model: ObservationModel) -> None:
    """Silence where all that is known expects a touch."""
    world, subject = settled(box_model)
    world.truth = np.array([5.0, 5.0, 0.0])
    silent = Activation(world.t + 1.0, np.zeros(32), np.ones(32, dtype=bool))
    sensor = se2.compose(TRUTH, box_side(box_model, 0.2, 0.004))
    assert subject.on_scan(silent, sensor).status is Status.INCONSISTENT


def test_a_wide_belief_has_more_particles(box_model: ObservationModel) -> None:
    subject = estimator(box_model, particles=50, particles_max=300)
    wide = approach(subject, box_model).particles
    _, narrow = settled(box_model)
    assert wide == 300
    assert narrow.estimate.particles < 150


def test_a_stuck_taxel_does_not_keep_the_object_from_being_found(
    box_model: ObservationModel,
) -> None:
    world = World(box_model)
    subject = Estimator(box_model, Knowing(world), FilterConfig())

    def on_scan(activation: Activation, sensor: Poses) -> Estimate:
        z = activation.z.copy()
        z[5] = 1.0
        return Estimator.on_scan(subject, replace(activation, z=z), sensor)

    subject.on_scan = on_scan  # type: ignore[method-assign]
    for angle in (0.2, 1.3, 2.9, 4.5, 5.5, 0.7):
        estimate = world.press(subject, angle)
    assert subject.counters.stuck > 0
    assert subject.rule.metric.distance(estimate.map, TRUTH) < 0.005


def test_it_thinks_until_enough_samples_have_left_a_narrow_belief_where_it_was(
    box_model: ObservationModel,
) -> None:
    """A held touch tells nothing new, but what is remembered may be explained better."""
    world = World(box_model)
    subject = Estimator(box_model, Knowing(world), FilterConfig(injected=20))

    def held(angle: float, scans: int) -> Estimate:
        for _ in range(scans):
            estimate = world.feel(subject, box_side(box_model, angle, 0.003))
        return estimate

    held(0.2, 20)
    assert subject.counters.thoughts == 0  # a lone touch is all that its samples know
    for touches, angle in enumerate((1.3, 2.9, 4.5), 1):
        world.press(subject, angle)
        estimate = held(angle, 20)
        assert 0 < subject.counters.thoughts <= 2 * touches * REVISITS
    assert estimate.status is Status.CONVERGED
    thoughts = subject.counters.thoughts
    held(4.5, 20)
    assert subject.counters.thoughts == thoughts
    assert subject.rule.metric.distance(estimate.map, TRUTH) < 0.003


def test_where_only_dead_taxels_would_feel_it_is_blind(box_model: ObservationModel) -> None:
    world, subject = settled(box_model)
    sensor = se2.compose(TRUTH, box_side(box_model, 0.2, 0.004))
    pressed = box_model.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0] > 0.0
    scan = Activation(world.t + 1.0, np.zeros(32), ~pressed)
    assert subject.on_scan(scan, sensor).status is Status.BLIND


def test_a_sensor_that_jumps_is_not_believed_until_it_stays(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    approach(subject, box_model)
    updates, far = subject.counters.updates, np.array([7.0, 0.0, 0.0])
    silent = Activation(1.0, np.zeros(32), np.ones(32, dtype=bool))
    subject.on_scan(silent, far)
    assert subject.counters.jumps == 1
    assert subject.counters.updates == updates
    subject.on_scan(replace(silent, t=1.05), far)
    assert subject.counters.jumps == 1
    assert subject.counters.updates == updates + 1


def test_a_pushed_object_of_which_the_place_was_known_is_confirmed_by_fewer_contacts(
    box_model: ObservationModel,
) -> None:
    """What the contacts before the push told is still known, as a prior."""
    world, subject = settled(box_model)
    rule = subject.rule
    assert isinstance(rule, Mixture)
    rule.push = lambda _, __, pose, *___: (pose, np.full(len(pose), 0.01))
    nothing = Observation(np.zeros(3), np.zeros(32), np.ones(32, dtype=np.bool_))
    rule.follow(nothing, nothing)
    assert status(rule.confidence, 5) is Status.AMBIGUOUS
    assert rule.memory.contacts == 0
    for angle in (0.2, 2.9):
        estimate = world.press(subject, angle)
    assert rule.memory.contacts < LEAST
    assert estimate.status is Status.CONVERGED
