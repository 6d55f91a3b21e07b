"""From scans to estimates: skin, sensor pose and estimator in one pure object.

The daemon's loop and the replay of a session run this same code. Time is measured only through the
clock that is passed in; a replay passes none and is the same, byte for byte, every time. What
arrives is handed in with the time of its arrival, so the same arrivals lead to the same estimates.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from taxeld import contacts, se2
from taxeld.bundle import Bundle
from taxeld.config import Config
from taxeld.estimate import Estimate, Status
from taxeld.estimator import Estimator
from taxeld.ladder import Ladder, Rung, Step
from taxeld.layout import Layout
from taxeld.poses import PoseTrack, StandingStill
from taxeld.se2 import Poses
from taxeld.skin import Activation, Skin
from taxeld_protocol.decoder import Scan

FUTURE_S = 0.1  # a scan that is stamped later than now by more was stamped wrongly
WAITING_MAX = 64  # scans; of more the oldest are let go
SILENT_PERIODS = 3.0  # without a scan of it for so long, a hub is silent

WARM_UP_TOUCHES = 5

ClockNs = Callable[[], int]


def no_clock() -> int:
    return 0


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one scan led to, and the time each stage took [ns]."""

    estimate: Estimate
    activation: Activation | None = None  # None while the baseline is learned, or not used
    sensor: Poses | None = None  # (3,) in the world; None where it is not known
    skin_ns: int = 0
    propose_ns: int = 0
    filter_ns: int = 0


@dataclass(slots=True)
class InputCounters:
    """Since start."""

    scans_old: int = 0  # that arrived when older than their limit, not used
    scans_from_the_future: int = 0  # later than now, or of no time at all, not used
    scans_without_pose: int = 0  # for which no sensor pose near in time came, not used
    scans_waited: int = 0  # for a pose at or after their time
    scans_put_off: int = 0  # to the next tick, as the time of this one was up
    scans_crowded_out: int = 0  # by too many that waited, not used
    clock_steps: int = 0  # of the Unix clock


class Pipeline:
    """Scans and sensor poses in, outcomes out."""

    def __init__(
        self, config: Config, layout: Layout, bundle: Bundle, clock: ClockNs = no_clock
    ) -> None:
        self.config = config
        self.clock = clock
        period_s = config.source.period_ms / 1000.0
        silent_s = max(config.source.max_age_s, SILENT_PERIODS * period_s)
        self.skin = Skin(layout, config.skin, silent_s)
        self.poses: PoseTrack | StandingStill = StandingStill()
        if config.sensor_pose.endpoint:
            self.poses = PoseTrack(config.sensor_pose.max_age_s)
        wanted, propose_ms = config.filter, config.budget.propose_ms
        chosen = bundle.proposal(wanted.proposal, wanted.sampler, wanted.injected, propose_ms)
        timed = clock is not no_clock
        rungs = bundle.ladder(chosen, wanted.injected) if timed else [Rung(Step.CHOSEN, chosen)]
        self.ladder = Ladder(rungs, clock, budget_ns=1e6 * propose_ms)
        self.estimator = Estimator(bundle.model, self.ladder, config.filter)
        self.estimate = replace(self.estimator.estimate, status=Status.STARTING)
        self.inputs = InputCounters()
        self._waiting: deque[tuple[float, Scan]] = deque()  # with the time of arrival
        self._stepped_s = 0.0  # by how much the clock was set since the start

    def advance(self, scans: Iterable[Scan], now: float) -> Iterator[Outcome]:
        """Take the scans that have arrived by `now`, after the sensor poses that have; → what they,
        and those that had been waiting, led to.

        A scan waits for a pose at or after its time, which may be on its way, but no longer than
        `sensor_pose.wait_s`; and for the next call, where the ladder's deadline has passed and
        another scan has been taken in this one.
        """
        for scan in scans:
            age = now - scan.t
            if -FUTURE_S <= age <= self.config.source.max_age_s:
                self._waiting.append((now, scan))
                self.inputs.scans_waited += self.poses.latest_t < scan.t
            else:
                yield self._refused(age)
        while self._waiting and self._is_due(*self._waiting[0], now):
            yield self.on_scan(self._waiting.popleft()[1])
            if self.ladder.is_late():
                self.inputs.scans_put_off += len(self._waiting)
                break
        while len(self._waiting) > WAITING_MAX:
            self._waiting.popleft()
            self.inputs.scans_crowded_out += 1

    def flush(self) -> Iterator[Outcome]:
        """What the scans that still wait led to, as nothing more will come."""
        while self._waiting:
            yield self.on_scan(self._waiting.popleft()[1])

    def clock_stepped(self, by: float) -> None:
        """The Unix clock was set: what it stamps is later by so much than what it stamped.

        The skin's times and the scans that wait are moved along; the poses are forgotten, as the
        robot's clock may have been set with this one or not; the estimator never notices.
        """
        self.inputs.clock_steps += 1
        self._stepped_s += by
        self.skin.clock_stepped(by)
        self.poses.clear()
        self._waiting = deque((t + by, replace(s, t=s.t + by)) for t, s in self._waiting)
        if self.estimate.t:  # it is of a scan
            self.estimate = replace(self.estimate, t=self.estimate.t + by)

    def _is_due(self, arrived: float, scan: Scan, now: float) -> bool:
        waited = now - arrived >= self.config.sensor_pose.wait_s
        return waited or self.poses.latest_t >= scan.t or len(self._waiting) > WAITING_MAX

    def _refused(self, age: float) -> Outcome:
        if age > 0.0:
            self.inputs.scans_old += 1
        else:
            self.inputs.scans_from_the_future += 1
        self.estimate = replace(self.estimate, status=Status.STALE)
        return Outcome(self.estimate)

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
            self.inputs.scans_without_pose += 1
            self.estimate = replace(self.estimate, t=scan.t, status=Status.STALE)
            return Outcome(self.estimate, activation, skin_ns=felt - start)
        before = self.ladder.spent_ns
        self.estimate = self._estimated(activation, sensor)
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
        self.ladder.settle()

    def input_counts(self) -> dict[str, int]:
        """What became of scans and poses before they were used; what waits has no count yet."""
        return {
            **asdict(self.inputs),
            "scans_waiting": len(self._waiting),
            "poses": self.poses.taken,
            "poses_rejected": self.poses.rejected,
            "poses_begun_again": self.poses.begun_again,
        }

    def health(self) -> dict[str, Any]:
        """Counters of the stages since start, and the taxels that cannot be believed."""
        return {
            "skin": self.skin.counters,
            "estimator": self.estimator.counters,
            "drift": self.skin.figures(),
            **self.skin.faults(),
        }

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched. The status is STARTING until
        that is done."""
        self.skin.tare()
        self.estimate = replace(self.estimate, status=Status.STARTING)

    def reset(self) -> None:
        """Forget what was felt."""
        self.estimator.reset()
        self.estimate = self.estimator.estimate

    def _estimated(self, activation: Activation, sensor: Poses) -> Estimate:
        """The estimator's word, whose own time goes on as if the clock had never been set."""
        by = self._stepped_s
        if not by:
            return self.estimator.on_scan(activation, sensor)
        estimate = self.estimator.on_scan(replace(activation, t=activation.t - by), sensor)
        return replace(estimate, t=estimate.t + by)


def is_valid(estimate: Estimate) -> bool:
    """Whether a subscriber may use it: fresh inputs, and something was touched."""
    return estimate.contacts > 0 and estimate.status in (
        Status.SEARCHING, Status.AMBIGUOUS, Status.CONVERGED,
    )  # fmt: skip
