"""From scans to estimates: skin, sensor pose and estimator in one pure object.

The daemon's loop and the replay of a session run this same code. Time is measured only through the
clock that is passed in; a replay passes none and is the same, byte for byte, every time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from taxeld import contacts, se2
from taxeld.bundle import Bundle
from taxeld.config import Config
from taxeld.estimate import Estimate, Status
from taxeld.estimator import Estimator
from taxeld.ladder import Ladder, LadderCounters, Rung
from taxeld.layout import Layout
from taxeld.poses import PoseTrack, StandingStill
from taxeld.se2 import Poses
from taxeld.skin import Activation, Skin
from taxeld_protocol.decoder import Scan

ClockNs = Callable[[], int]

WARM_UP_TOUCHES = 5


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
        wanted, propose_ms = config.filter, config.budget.propose_ms
        chosen = bundle.proposal(wanted.proposal, wanted.sampler, wanted.injected, propose_ms)
        timed = clock is not no_clock
        steps = bundle.ladder(chosen, wanted.injected) if timed else [Rung(chosen)]
        self.ladder = Ladder(steps, clock, budget_ns=1e6 * propose_ms)
        self.estimator = Estimator(bundle.model, self.ladder, config.filter)
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
        before = self.ladder.spent_ns
        self.estimate = self.estimator.on_scan(activation, sensor)
        self.ladder.used()
        propose_ns = self.ladder.spent_ns - before
        filter_ns = self.clock() - felt - propose_ns
        return Outcome(self.estimate, activation, sensor, felt - start, propose_ns, filter_ns)

    def warm_up(self) -> None:
        """Touch the object a few times in another's place: code and memory are there, and what a
        touch costs is known, before the first one."""
        model, rng = self.estimator.model, np.random.default_rng(0)
        radius_m, depth_m = model.layout.radius_m, model.depth_max_m
        poses = contacts.synthesise(model.scene, radius_m, depth_m, 8 * WARM_UP_TOUCHES, rng).pose
        subject = Estimator(model, self.ladder, self.config.filter)
        live = np.ones(len(model.layout), dtype=np.bool_)
        for k, pose in enumerate(poses[:WARM_UP_TOUCHES]):
            z = model.activation(pose[None])[0]
            for late_s, felt in ((0.0, z), (0.05, z), (0.1, 0.0 * z), (0.5, 0.0 * z)):
                subject.on_scan(Activation(k + late_s, felt, live), se2.inverse(pose))
                self.ladder.used()
        self.ladder.counters = LadderCounters()

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
