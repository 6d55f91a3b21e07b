"""The estimator: what it learns from, and that nothing it is given, in any order, upsets it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator import particles as pf
from taxeld.estimator import scans
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.object_belief import ROOM
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.proposals.analytic import Manifold, Projection
from tests.rig.examples import examples
from tests.rig.pressed_box import (
    TRUTH,
    World,
    approach,
    box_side,
    estimator,
    feel,
    press,
    settled,
)


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_a_held_contact_counts_once(box_model: ObservationModel, noise: float) -> None:
    """Half a minute at 20 Hz of the same touch leaves the belief as it was."""
    subject, rng = estimator(box_model), np.random.default_rng(0)
    before = approach(subject, box_model)
    updates = subject.counters.updates
    for k in range(600):
        felt = feel(box_model, press(-0.004), 1.0 + 0.05 * k)
        off = np.where(felt.z > 0.0, noise * rng.standard_normal(len(felt.z)), 0.0)
        after = subject.on_scan(replace(felt, z=np.clip(felt.z + off, 0.0, 1.0)), press(-0.004))
    assert subject.counters.updates == updates
    assert after.ess == before.ess
    assert np.array_equal(after.cov, before.cov)
    assert after.contacts == 1
    assert after.contact


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
    far = np.hypot(*subject.belief.particles.pose[:, :2].T)
    assert far.max() <= ROOM * FilterConfig().half_width_m


def test_a_sensor_that_goes_far_away_does_not_draw_the_belief_after_it(
    box_model: ObservationModel,
) -> None:
    subject = estimator(box_model, injected=20)
    approach(subject, box_model)
    away = se2.compose(press(0.0), np.array([5.0, 0.0, 0.0]))
    for t in (2.0, 2.05):  # where it stays it is believed
        subject.on_scan(Activation(t, np.zeros(32), np.ones(32, dtype=bool)), away)
    assert (subject.counters.jumps, subject.belief.memory.number[-1]) == (1, 1)
    assert np.allclose(subject.belief.memory.sensor[subject.belief.memory.contact], press(-0.004))
    pose = subject.belief.particles.pose
    room = pf.Room(press(-0.004)[:2], ROOM * FilterConfig().half_width_m)
    assert room.lets(pose, pose + 1e-3).all()


def test_same_seed_same_bytes_after_a_reset_as_well(box_model: ObservationModel) -> None:
    one, other = estimator(box_model, seed=3), estimator(box_model, seed=4)
    first = messages_of(approach(one, box_model))
    assert messages_of(approach(other, box_model)) != first
    one.reset()
    assert one.estimate.contacts == 0
    assert messages_of(approach(one, box_model)) == first


def test_by_the_papers_rule_a_contact_asks_for_fewer_samples_than_the_one_before_down_to_none(
    box_model: ObservationModel,
) -> None:
    asked = []

    class Asked(Projection):
        def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
            asked.append(n)
            return super().propose(z, live, n, rng)

    subject = Estimator(box_model, Asked(box_model), FilterConfig(injection="paper"))
    for k in range(8):
        approach(subject, box_model, t=10.0 * k)
    assert not len(subject.belief.memory)
    assert asked == [50, 25, 12, 6, 3, 2, 1]


def test_a_long_press_makes_room_for_itself_and_no_other_contact_is_forgotten(
    box_model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scans, "REMEMBERED", 4)
    subject = estimator(box_model, injected=0)
    for contact in range(1, 4):
        approach(subject, box_model, t=10.0 * contact)
    for k in range(20):  # along the face, in steps that tell something new
        at = se2.compose(press(-0.004), np.array([0.0, 0.004 * k, 0.0]))
        subject.on_scan(feel(box_model, at, 40.0 + 0.05 * k), at)
    belief = subject.belief
    assert belief.memory.number[belief.memory.contact].tolist() == [1, 2, 3, 3]
    assert len(belief.memory) <= 4 + scans.SILENT_MAX
    explained = belief.memory.explain(belief.particles.pose)
    assert np.allclose(explained.scans, belief.particles.explained.scans)


def test_scans_back_in_time_change_nothing(box_model: ObservationModel) -> None:
    subject = estimator(box_model)
    before = approach(subject, box_model)
    after = subject.on_scan(feel(box_model, press(0.01), 0.1), press(0.01))
    assert np.array_equal(after.map, before.map)
    assert after.t == before.t


def test_a_belief_that_becomes_impossible_begins_anew(box_model: ObservationModel) -> None:
    """With silence where a touch was expected; a touch after it leaves its own samples."""
    world, subject = settled(box_model)
    subject.belief.particles.log_weight[:] = -np.inf
    expected = se2.compose(TRUTH, box_side(box_model, 0.2, 0.004))
    subject.on_scan(Activation(100.0, np.zeros(32), np.ones(32, dtype=bool)), expected)
    assert np.isclose(subject.belief.particles.weight.sum(), 1.0)
    assert np.ptp(subject.belief.particles.pose[:, 0]) > 0.5
    subject.belief.particles.log_weight[:] = -np.inf
    world.t = 101.0
    world.press(subject, 1.3)
    near = subject.belief.metric.distance(subject.belief.particles.pose, TRUTH) < 0.02
    assert near.mean() > 0.9


def test_searches_come_one_at_a_time_when_asked_for(box_model: ObservationModel) -> None:
    """The result is the same whether each is taken with its scan, or later but before the next."""
    world, changed = World(box_model), 0
    at_once, later = world.knowing(), world.knowing()
    for k in range(40):
        deep_m = -0.02 if k % 5 > 2 else 0.003
        world.sensor = sensor = se2.compose(TRUTH, box_side(box_model, 1.35 * (k // 5), deep_m))
        activation = feel(box_model, sensor, 0.2 * k)
        whole = messages_of(at_once.on_scan(activation, sensor))
        first = messages_of(later.on_scan(activation, sensor, thinks=False))
        had_thought = later.has_thought
        changed += later.think()
        assert not later.has_thought
        assert not later.think()
        assert messages_of(later.estimate) == whole
        assert had_thought or first == whole
    assert changed == at_once.counters.thoughts > 0


def messages_of(estimate: Estimate) -> str:
    return repr(replace(estimate, modes=())) + repr([m.pose.tolist() for m in estimate.modes])


TAXELS = 32
near = st.tuples(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(-4, 4))
anything = st.sampled_from([0.0, 0.3, 1.0, 7.0, -3.0, np.nan, np.inf, -np.inf]) | st.floats(
    0.05, 1.0
)


class AnyInput(RuleBasedStateMachine):
    """A skin about an object at the origin, with all that can go wrong."""

    model: ObservationModel

    @initialize(
        injection=st.sampled_from(["mixture", "paper"]),
        motion=st.sampled_from(["none", "push"]),
        particles=st.integers(2, 30),
        injected=st.integers(0, 20),
        known=st.integers(1, 3),
    )
    def begin(self, injection: str, motion: str, particles: int, injected: int, known: int) -> None:
        if injection == "paper":
            motion = "none"  # as a configuration has it
        if injection == "paper" or motion == "push":
            known = 1
        config = FilterConfig(
            injection=injection,
            motion=motion,
            particles=particles,
            particles_max=60,
            injected=injected,
        )
        more = [Known(self.model, Manifold(self.model))] * (known - 1)
        self.subject = Estimator(self.model, Manifold(self.model), config, more=more)
        self.t, self.scans = 0.0, 0
        self.live = np.ones(TAXELS, dtype=bool)
        self.sensor = np.array([0.3, 0.0, 0.0])

    def scan(self, z: np.ndarray, sensor: np.ndarray, later: float = 0.05) -> None:
        self.t += later
        self.scans += 1
        self.estimate = self.subject.on_scan(Activation(self.t, z, self.live), sensor)

    @rule(to=near, times=st.integers(1, 4))
    def feel_what_is_there(self, to: tuple[float, ...], times: int) -> None:
        self.sensor = np.array(to)
        z = self.model.activation(se2.inverse(self.sensor)[None])[0]
        for _ in range(times):
            self.scan(z, self.sensor)

    @rule(by=near, times=st.integers(1, 5))
    def slide(self, by: tuple[float, ...], times: int) -> None:
        for _ in range(times):
            self.sensor = self.sensor + 0.02 * np.array(by)
            z = self.model.activation(se2.inverse(self.sensor)[None])[0]
            self.scan(z, self.sensor)

    @rule(at=st.integers(0, TAXELS - 1), value=anything, times=st.integers(1, 4))
    def one_value_is_anything(self, at: int, value: float, times: int) -> None:
        z = np.zeros(TAXELS)
        z[at] = value
        for _ in range(times):
            self.scan(z, self.sensor)

    @rule(at=st.integers(0, 2), value=st.sampled_from([np.nan, np.inf, 1e9, -40.0]))
    def the_sensor_is_anywhere(self, at: int, value: float) -> None:
        sensor = self.sensor.copy()
        sensor[at] = value
        self.scan(np.zeros(TAXELS), sensor)

    @rule(by=st.sampled_from([-5.0, 0.0, 1.0, 1e6]))
    def the_clock_steps(self, by: float) -> None:
        self.scan(np.zeros(TAXELS), self.sensor, later=by)

    @rule(dead=st.sets(st.integers(0, TAXELS - 1)))
    def taxels_die(self, dead: set[int]) -> None:
        self.live = ~np.isin(np.arange(TAXELS), list(dead))

    @rule()
    def all_taxels_die(self) -> None:
        self.live = np.zeros(TAXELS, dtype=bool)
        for _ in range(2):  # after a jump of the sensor the first is not used
            self.scan(np.zeros(TAXELS), self.sensor, later=1e7)  # never before one that was used
        assert self.estimate.status is not Status.CONVERGED

    @rule()
    def reset(self) -> None:
        self.subject.reset()
        self.t = 0.0

    @invariant()
    def the_state_is_finite(self) -> None:
        if not hasattr(self, "subject"):
            return
        belief, estimate = self.subject.belief.particles, self.subject.estimate
        assert np.isfinite(belief.pose).all()
        assert np.isfinite(belief.explained.scans).all()
        assert np.isclose(belief.weight.sum(), 1.0)
        assert 1 <= len(belief) <= 60
        assert np.isfinite([*estimate.map, *estimate.mean, estimate.ess, estimate.t]).all()
        assert np.isfinite(estimate.cov).all()
        assert np.isclose(sum(estimate.objects) + estimate.hypotheses.other, 1.0)
        assert not self.subject.bank.is_behind

    @invariant()
    def every_scan_is_counted(self) -> None:
        if hasattr(self, "subject"):
            assert self.subject.counters.scans == self.scans


@pytest.fixture(autouse=True)
def _model(box_model: ObservationModel) -> None:
    AnyInput.model = box_model


TestAnyInput = AnyInput.TestCase
TestAnyInput.settings = settings(examples(60), stateful_step_count=30)
