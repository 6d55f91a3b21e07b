"""From scans to estimates: skin, sensor pose and estimator in one pure object.

The daemon's loop and the replay of a session run this same code. Time is measured only through the
clock that is passed in; a replay passes none and is the same, byte for byte, every time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from taxeld.bundle import Bundle
from taxeld.config import Config
from taxeld.estimate import Estimate, Status
from taxeld.estimator import Estimator
from taxeld.layout import Layout
from taxeld.poses import PoseTrack, StandingStill
from taxeld.proposals import Proposal
from taxeld.se2 import Poses
from taxeld.skin import Activation, Skin
from taxeld_protocol.decoder import Scan

ClockNs = Callable[[], int]


def no_clock() -> int:
    return 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one scan led to, and the time each stage took [ns]."""

    estimate: Estimate
    activation: Activation | None = None  # None while the baseline is learned
    sensor: Poses | None = None  # (3,) in the world; None where it is not known
    skin_ns: int = 0
    propose_ns: int = 0
    filter_ns: int = 0


class _Timed:
    """A proposal that notes how long it took."""

    def __init__(self, inner: Proposal, clock: ClockNs) -> None:
        self.name = inner.name
        self.spent_ns = 0
        self._inner = inner
        self._clock = clock

    def propose(self, z, live, n, rng) -> Poses:  # type: ignore[no-untyped-def]
        start = self._clock()
        poses = self._inner.propose(z, live, n, rng)
        self.spent_ns += self._clock() - start
        return poses


class Pipeline:
    """Scans and sensor poses in, outcomes out."""

    def __init__(
        self, config: Config, layout: Layout, bundle: Bundle, clock: ClockNs = no_clock
    ) -> None:
        self.config = config
        self.clock = clock
        self.skin = Skin(layout, config.skin)
        self.poses: PoseTrack | StandingStill = StandingStill()
        if config.sensor_pose.endpoint:
            self.poses = PoseTrack(config.sensor_pose.max_age_s)
        wanted = config.filter
        proposal = bundle.proposal(
            wanted.proposal, wanted.sampler, wanted.injected, wanted.propose_budget_ms
        )
        self._proposal = _Timed(proposal, clock)
        self.estimator = Estimator(bundle.model, self._proposal, config.filter)
        self.estimate = replace(self.estimator.estimate, status=Status.STARTING)
        self.without_pose = 0

    def on_scan(self, scan: Scan) -> Outcome:
        """Take a scan; the sensor's poses up to its time must have been added."""
        start = self.clock()
        activation = self.skin.on_scan(scan)
        felt = self.clock()
        if activation is None:
            self.estimate = replace(self.estimate, t=scan.t, status=Status.STARTING)
            return Outcome(self.estimate, skin_ns=felt - start)
        sensor = self.poses.at(scan.t)
        if sensor is None:
            self.without_pose += 1
            self.estimate = replace(self.estimate, t=scan.t, status=Status.STALE)
            return Outcome(self.estimate, activation, skin_ns=felt - start)
        before = self._proposal.spent_ns
        self.estimate = self.estimator.on_scan(activation, sensor)
        propose_ns = self._proposal.spent_ns - before
        filter_ns = self.clock() - felt - propose_ns
        return Outcome(self.estimate, activation, sensor, felt - start, propose_ns, filter_ns)

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched."""
        self.skin.tare()

    def reset(self) -> None:
        """Forget what was felt."""
        self.estimator.reset()
        self.estimate = self.estimator.estimate


def is_valid(estimate: Estimate) -> bool:
    """Whether a subscriber may use it: fresh inputs, and something was touched."""
    return estimate.contacts > 0 and estimate.status in (
        Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED,
    )  # fmt: skip
