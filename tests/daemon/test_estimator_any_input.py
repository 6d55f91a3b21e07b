"""Whatever comes, in whatever order, the estimator's state stays finite and nothing raises."""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from taxeld.config.tables import FilterConfig
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.proposals.analytic import Manifold

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
        belief, estimate = self.subject.rule.belief, self.subject.estimate
        assert np.isfinite(belief.pose).all()
        assert np.isfinite(belief.remembered).all()
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
TestAnyInput.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
