"""The estimator: what it learns from, and that nothing it is given brings it down."""

import json
from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator.confidence import Confidence
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import REVISITS, ROOM, SILENT_MAX, Mixture
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.poses import PoseTrack
from taxeld.proposals.analytic import Projection
from taxeld.stream import messages

TRUTH = np.array([0.1, 0.05, 0.3])
SPREAD = 0.6  # of the gains of a rough skin: the model takes 0.17


def estimator(model: ObservationModel, **keys: int | str) -> Estimator:
    return Estimator(model, Projection(model), FilterConfig(**keys))  # type: ignore[arg-type]


def feel(model: ObservationModel, sensor: np.ndarray, t: float) -> Activation:
    seen = se2.compose(se2.inverse(sensor), TRUTH)
    z = model.activation(seen[None])[0]
    return Activation(t, np.where(z > 0.02, z, 0.0), np.ones(len(z), dtype=bool))


def press(gap_m: float) -> np.ndarray:
    """A sensor pose that far from the box's long face, on its x axis."""
    return se2.compose(TRUTH, np.array([0.03 + 0.04 + gap_m, 0.01, 0.0]))


def approach(subject: Estimator, model: ObservationModel, t: float = 0.0) -> Estimate:
    """A press of 4 mm in steps of 1 mm; → the estimate when it is held."""
    for gap in (0.02, 0.01, 0.002, -0.001, -0.002, -0.003, -0.004, -0.004):
        subject.on_scan(feel(model, press(gap), t), press(gap))
        t += 0.05
    return subject.estimate


def sharpness(estimate: Estimate) -> tuple[float, float]:
    return estimate.ess, float(np.trace(estimate.cov))


def test_without_samples_there_is_nothing_to_think_with(box_model: ObservationModel) -> None:
    """Two touches that do not agree, and filter.injected = 0."""
    subject = estimator(box_model, particles=2, particles_max=60, injected=0)
    approach(subject, box_model)
    odd = np.zeros(len(box_model.layout))
    for k, value in enumerate((0.0, 0.0, 1.0, 1.0, 1.0, 1.0)):
        odd[0] = value
        reading = Activation(1.0 + 0.05 * k, odd.copy(), np.ones(len(odd), dtype=bool))
        subject.on_scan(reading, press(0.1))
    assert subject.counters.thoughts == 0
    assert np.isclose(subject.rule.belief.weight.sum(), 1.0)


def test_a_held_contact_counts_once(box_model: ObservationModel) -> None:
    """Ten minutes at 20 Hz of the same touch leave the belief as it was."""
    subject = estimator(box_model)
    before = approach(subject, box_model)
    updates = subject.counters.updates
    for k in range(12_000):
        after = subject.on_scan(feel(box_model, press(-0.004), 1.0 + 0.05 * k), press(-0.004))
    assert subject.counters.updates == updates
    assert sharpness(after) == sharpness(before)
    assert after.contacts == 1
    assert after.contact


def test_a_held_contact_with_noise_counts_once_as_well(box_model: ObservationModel) -> None:
    subject, rng = estimator(box_model), np.random.default_rng(0)
    approach(subject, box_model)
    updates = subject.counters.updates
    for k in range(2000):
        felt = feel(box_model, press(-0.004), 1.0 + 0.05 * k)
        z = np.clip(
            felt.z + np.where(felt.z > 0, 0.005 * rng.standard_normal(len(felt.z)), 0), 0, 1
        )
        subject.on_scan(Activation(felt.t, z, felt.live), press(-0.004))
    assert subject.counters.updates == updates


def test_a_press_is_judged_when_it_stops_deepening(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    judged = []
    for k, gap in enumerate((0.02, -0.001, -0.002, -0.003, -0.004, -0.004, -0.004)):
        estimate = subject.on_scan(feel(box_model, press(gap), 0.05 * k), press(gap))
        judged.append(estimate.injected > 0)
    assert judged == [False] * 5 + [True, False]


def test_a_flicker_does_not_begin_a_contact(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    approach(subject, box_model)
    silent = Activation(0.4, np.zeros(32), np.ones(32, dtype=bool))
    assert subject.on_scan(silent, press(-0.004)).contact
    assert subject.on_scan(feel(box_model, press(-0.004), 0.45), press(-0.004)).contacts == 1
    assert not subject.on_scan(replace(silent, t=1.5), press(0.01)).contact
    assert subject.on_scan(feel(box_model, press(-0.004), 1.6), press(-0.004)).contacts == 2


def test_a_touch_that_may_be_noise_confirms_nothing(box_model: ObservationModel) -> None:
    """The first light scan of a press whose deepest may yet refute the belief."""
    subject = estimator(box_model, injected=0)
    near = TRUTH + 1e-4 * np.random.default_rng(0).standard_normal((100, 3))
    rule = subject.rule
    rule.belief = pf.equal(near, np.empty((100, 0)))
    rule.confidence = Confidence.of(rule.belief, box_model.scene)
    for t, gap, confirmed in ((0.0, -0.00015, False), (1.0, -0.003, True)):
        for k in range(3):
            subject.on_scan(feel(box_model, press(gap), t + 0.05 * k), press(gap))
        assert subject.estimate.contact
        assert rule.confidence.confirmed is confirmed


def test_touches_that_no_pose_explains_do_not_drive_the_belief_away(
    box_model: ObservationModel,
) -> None:
    """A broken skin, for hours: far away all poses explain the same, and there is room without
    end."""
    subject, rng, t = estimator(box_model, injected=20), np.random.default_rng(0), 0.0
    for _ in range(60):
        for pressed in (True, True, False, False, False, False, False):
            z = np.zeros(32)
            z[rng.permutation(32)[: 4 * pressed]] = 1.0
            subject.on_scan(Activation(t, z, np.ones(32, dtype=bool)), se2.IDENTITY)
            t += 0.05
    far = np.hypot(*subject.rule.belief.pose[:, :2].T)
    assert far.max() <= ROOM * FilterConfig().half_width_m


def test_a_sensor_that_goes_far_away_does_not_draw_the_belief_after_it(
    box_model: ObservationModel,
) -> None:
    subject = estimator(box_model, injected=20)
    approach(subject, box_model)
    away = se2.compose(press(0.0), np.array([5.0, 0.0, 0.0]))
    subject.on_scan(Activation(2.0, np.zeros(32), np.ones(32, dtype=bool)), away)
    room = subject.rule._room()
    assert np.allclose(room.centre, press(-0.004)[:2])
    assert room.lets(subject.rule.belief.pose, subject.rule.belief.pose + 1e-3).all()


def test_touching_nothing_is_evidence(box_model: ObservationModel) -> None:
    """Silence where particles expect touch removes their weight."""
    subject = estimator(box_model)
    subject.rule.belief.pose[:] = [0.0, 0.0, 0.0]
    subject.rule.belief.pose[:50] = [0.5, 0.5, 0.0]
    sensor = np.array([0.068, 0.0, 0.0])  # pressed 2 mm by the half that stands at the origin
    subject.on_scan(Activation(0.0, np.zeros(32), np.ones(32, dtype=bool)), sensor)
    weight = subject.rule.belief.weight
    near = np.hypot(*subject.rule.belief.pose[:, :2].T) < 0.2
    assert weight[near].sum() < 0.01


def test_same_seed_same_bytes(box_model: ObservationModel) -> None:
    def run(seed: int) -> str:
        subject = estimator(box_model, seed=seed)
        return json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_reset_begins_anew(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    first = json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))
    subject.reset()
    assert subject.estimate.contacts == 0
    again = json.dumps(messages.estimate(approach(subject, box_model), seq=0, valid=True))
    assert again == first


def test_without_live_taxels_it_is_blind(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    dead = Activation(0.0, np.ones(32), np.zeros(32, dtype=bool))
    assert subject.on_scan(dead, np.zeros(3)).status is Status.BLIND


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_counted(box_model: ObservationModel, bad: float) -> None:
    subject = estimator(box_model)
    z, live = np.zeros(32), np.ones(32, dtype=bool)
    z[3] = bad
    subject.on_scan(Activation(0.0, z, live), np.zeros(3))
    subject.on_scan(Activation(0.0, np.zeros(32), live), np.array([0.0, bad, 0.0]))
    assert subject.counters.bad_input == 2
    assert np.isfinite(subject.rule.belief.pose).all()


def test_poses_are_interpolated_through_the_turn() -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 3.1)
    track.add(1.1, 0.1, -0.2, -3.1)
    pose = track.at(1.05)
    assert pose is not None
    assert np.allclose(pose[:2], [0.05, -0.1])
    assert np.isclose(abs(pose[2]), np.pi)


@pytest.mark.parametrize(("t", "known"), [(0.9, False), (1.0, True), (1.3, True), (1.31, False)])
def test_a_pose_too_old_or_too_young_is_none(t: float, known: bool) -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 0.0)
    track.add(1.1, 0.0, 0.0, 0.0)
    assert (track.at(t) is not None) == known


def test_poses_back_in_time_or_not_finite_are_rejected() -> None:
    track = PoseTrack(max_age_s=0.2)
    track.add(1.0, 0.0, 0.0, 0.0)
    for row in ((1.0, 1, 1, 1), (0.5, 1, 1, 1), (2.0, np.nan, 0, 0), (np.nan, 0, 0, 0)):
        track.add(*row)
    assert track.rejected == 4
    assert track.latest_t == 1.0


def test_by_the_papers_rule_nothing_is_remembered(box_model: ObservationModel) -> None:
    subject = estimator(box_model, injection="paper")
    approach(subject, box_model)
    assert subject.counters.injections == 1
    assert len(subject.rule.belief) == 100
    assert not hasattr(subject.rule, "memory")


@pytest.mark.parametrize(
    ("decay", "expected"), [(0.5, [50, 25, 12, 6, 3, 2, 1]), (0.0, [50]), (1.0, [50] * 8)]
)
def test_by_the_papers_rule_a_contact_asks_for_fewer_samples_than_the_one_before_down_to_none(
    box_model: ObservationModel, decay: float, expected: list[int]
) -> None:
    asked = []

    class Asked(Projection):
        def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
            asked.append(n)
            return super().propose(z, live, n, rng)

    config = FilterConfig(injection="paper", injected_decay=decay)
    subject = Estimator(box_model, Asked(box_model), config)
    for k in range(8):
        approach(subject, box_model, t=10.0 * k)
    assert asked == expected


def test_the_memory_is_bounded(box_model: ObservationModel) -> None:
    subject = estimator(box_model, memory=3)
    for k in range(6):
        approach(subject, box_model, t=10.0 * k)
    rule = subject.rule
    assert isinstance(rule, Mixture)
    assert np.count_nonzero(rule.memory.contact) == 3
    assert len(rule.memory) <= 3 + SILENT_MAX
    assert np.allclose(rule.memory.explain(rule.belief.pose), rule.belief.remembered)


def test_a_long_press_makes_room_for_itself_and_no_other_contact_is_forgotten(
    box_model: ObservationModel,
) -> None:
    subject = estimator(box_model, memory=4, injected=0)
    for contact in range(1, 4):
        approach(subject, box_model, t=10.0 * contact)
    numbers = []
    for k in range(20):  # along the face, in steps that tell something new
        at = se2.compose(press(-0.004), np.array([0.0, 0.004 * k, 0.0]))
        subject.on_scan(feel(box_model, at, 40.0 + 0.05 * k), at)
        rule = subject.rule
        assert isinstance(rule, Mixture)
        numbers = rule.memory.number[rule.memory.contact].tolist()
    assert numbers == [1, 2, 3, 3]


class Knowing:
    """A proposal that knows the truth to a few millimetres: what is tested is what follows."""

    name = "table"

    def __init__(self, world: "World") -> None:
        self._world = world

    def propose(self, z: np.ndarray, live: np.ndarray, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        seen = se2.compose(se2.inverse(self._world.sensor), self._world.truth)
        return np.asarray(seen + rng.standard_normal((n, 3)) * (0.003, 0.003, 0.05))


class World:
    """An object, and presses of it from all sides."""

    def __init__(self, model: ObservationModel) -> None:
        self.model, self.truth, self.sensor, self.t = model, TRUTH, np.zeros(3), 0.0
        self.gain: Floats | float = 1.0  # of the taxels

    def press(self, subject: Estimator, angle: float, depth_m: float = 0.003) -> Estimate:
        """Come near at an angle about the object, press, hold, let go; → the held estimate."""
        seen = box_side(self.model, angle, depth_m)
        away = box_side(self.model, angle, -0.02)
        for at in (away, seen, seen, seen):
            held = self.feel(subject, at)
        self.feel(subject, away)
        self.t += 1.0
        self.feel(subject, away)
        return held

    def feel(self, subject: Estimator, at: Poses) -> Estimate:
        self.sensor = se2.compose(self.truth, at)
        z = np.minimum(self.gain * self.model.activation(se2.inverse(at)[None])[0], 1.0)
        self.t += 0.05
        activation = Activation(self.t, z, np.ones(len(z), dtype=bool))
        return subject.on_scan(activation, self.sensor)


def box_side(model: ObservationModel, angle: float, depth_m: float) -> Poses:
    """The sensor's pose in the object's frame as it comes from an angle, so deep."""
    far = np.linspace(0.3, 0.0, 3001)
    at = np.column_stack([far * np.cos(angle), far * np.sin(angle), np.full(3001, angle)])
    gap = contacts.clearance(model.scene, model.layout.radius_m, se2.inverse(at))
    return np.asarray(at[np.argmax(gap < -depth_m)])


def settled(model: ObservationModel) -> tuple[World, Estimator]:
    world = World(model)
    subject = Estimator(model, Knowing(world), FilterConfig())
    for angle in (0.2, 1.3, 2.9, 4.5):
        estimate = world.press(subject, angle)
    assert estimate.status is Status.CONVERGED
    assert subject.rule.confidence.metric.distance(estimate.map, TRUTH) < 0.003
    return world, subject


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
    assert subject.counters.rule.forgotten == 0
    assert subject.rule.confidence.metric.distance(estimate.map, TRUTH) < 0.005


def test_an_object_that_was_moved_is_inconsistent_and_then_found(
    box_model: ObservationModel,
) -> None:
    world, subject = settled(box_model)
    world.truth = np.array([-0.1, 0.1, 2.0])
    assert world.press(subject, 0.2).status is Status.INCONSISTENT
    assert subject.counters.rule.forgotten == 0
    for angle in (1.3, 2.9, 4.5):
        estimate = world.press(subject, angle)
    assert subject.counters.rule.forgotten == 1
    assert estimate.status is Status.CONVERGED
    assert subject.rule.confidence.metric.distance(estimate.map, world.truth) < 0.003


def test_one_touch_of_something_else_does_not_move_the_object(box_model: ObservationModel) -> None:
    world, subject = settled(box_model)
    world.truth = np.array([-0.1, 0.1, 2.0])
    assert world.press(subject, 0.2).status is Status.INCONSISTENT
    world.truth = TRUTH
    estimate = world.press(subject, 3.6)
    assert subject.counters.rule.forgotten == 0
    assert subject.rule.confidence.metric.distance(estimate.map, TRUTH) < 0.003
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


def test_scans_back_in_time_change_nothing(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    before = approach(subject, box_model)
    after = subject.on_scan(feel(box_model, press(0.01), 0.1), press(0.01))
    assert subject.counters.back_in_time == 1
    assert np.array_equal(after.map, before.map)
    assert after.t == before.t


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


def test_activations_beyond_their_range_are_clipped_and_counted(
    box_model: ObservationModel,
) -> None:
    subject = estimator(box_model)
    z = np.zeros(32)
    z[:2] = 7.0, -1.0
    for t in (0.0, 0.05):
        subject.on_scan(Activation(t, z, np.ones(32, dtype=bool)), np.zeros(3))
    assert subject.counters.out_of_range == 2
    assert subject.counters.injections == 1


def test_where_only_dead_taxels_would_feel_it_is_blind(box_model: ObservationModel) -> None:
    world, subject = settled(box_model)
    sensor = se2.compose(TRUTH, box_side(box_model, 0.2, 0.004))
    pressed = box_model.activation(se2.compose(se2.inverse(sensor), TRUTH)[None])[0] > 0.0
    scan = Activation(world.t + 1.0, np.zeros(32), ~pressed)
    assert subject.on_scan(scan, sensor).status is Status.BLIND
    assert subject.counters.blind == 1


def test_a_belief_that_becomes_impossible_begins_anew(box_model: ObservationModel) -> None:
    _, subject = settled(box_model)
    subject.rule.belief.log_weight[:] = -np.inf
    subject.on_scan(feel(box_model, press(0.2), 100.0), press(0.2))
    assert subject.counters.rule.impossible == 1
    assert np.isclose(subject.rule.belief.weight.sum(), 1.0)


def test_a_belief_that_a_touch_makes_impossible_begins_with_its_samples(
    box_model: ObservationModel,
) -> None:
    world, subject = settled(box_model)
    subject.rule.belief.log_weight[:] = -np.inf
    world.feel(subject, box_side(box_model, 1.3, -0.02))  # the belief is uniform now
    subject.rule.belief.log_weight[:] = -np.inf
    world.press(subject, 1.3)
    assert subject.counters.rule.impossible == 2
    assert np.isclose(subject.rule.belief.weight.sum(), 1.0)
    near = subject.rule.confidence.metric.distance(subject.rule.belief.pose, TRUTH) < 0.02
    assert near.mean() > 0.9


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
    assert subject.rule.confidence.metric.distance(estimate.map, TRUTH) < 0.005


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
    assert subject.rule.confidence.metric.distance(estimate.map, TRUTH) < 0.003


def test_a_scan_taken_in_parts_leads_where_the_same_at_once_does(
    box_model: ObservationModel,
) -> None:
    whole, parted = estimator(box_model), estimator(box_model)
    most = 0
    for k in range(6):
        sensor = press(0.002 * (k % 2) - 0.004)
        activation = feel(box_model, sensor, 0.2 * k)
        before = parted.estimate
        parts = 0
        for _ in parted.parts(activation, sensor):
            parts += 1
            assert parted.estimate is before
        most = max(most, parts)
        assert messages_of(whole.on_scan(activation, sensor)) == messages_of(parted.estimate)
    assert most >= 4  # a touch has several


def test_a_scan_that_is_put_down_half_way_can_be_forgotten(box_model: ObservationModel) -> None:
    subject, fresh = estimator(box_model), estimator(box_model)
    for pauses in range(5):
        parts = subject.parts(feel(box_model, press(-0.004), 0.0), press(-0.004))
        for _, _ in zip(range(pauses), parts, strict=False):
            pass
        parts.close()
        subject.reset()
    assert messages_of(approach(subject, box_model)) == messages_of(approach(fresh, box_model))


def messages_of(estimate: Estimate) -> str:
    return repr(replace(estimate, modes=())) + repr([m.pose.tolist() for m in estimate.modes])
