"""From scans to estimates: skin, sensor pose and estimator in one pure object.

The daemon's loop and the replay of a session run this same code. Arrivals are handed in with their
times, so the same arrivals give the same estimates, byte for byte. Durations are measured by the
ladder's clock, if it has one.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.estimator.rule import noise_of
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.calibrated import calibrated
from taxeld.pipeline.calibration_check import CalibrationCheck
from taxeld.pipeline.freshness import Freshness, Why
from taxeld.pipeline.outcome import InputCounters, Outcome, later
from taxeld.pipeline.poses import EXTRAPOLATE_S, OnPose, PoseTrack, StandingStill
from taxeld.proposals.ladder import Ladder
from taxeld.skin.calibration import Calibration
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState
from taxeld.told import ToldPose
from taxeld_protocol.decoder import Scan

FUTURE_S = 0.1  # a scan stamped farther in the future was stamped wrongly
SCAN_AGE_S = 0.5  # a scan that is older when it arrives is not used
WAITING_MAX = 64  # scans that may wait; beyond, the oldest wait no longer
CONTACTS, LEAST_CONTACTS = 12, 4  # contacts of a lesson, and of one before all is forgotten
SILENT_PERIODS = 3.0  # scan periods without a scan: a hub is silent, all is stale


class Pipeline:
    """Scans and sensor poses in, outcomes out.

    Times are Unix times outside, also those of the sensor's poses. The skin, the estimator and
    waiting scans use a time without the steps of the Unix clock: Unix time less `_stepped_s`.
    """

    def __init__(
        self,
        config: Config,
        model: ObservationModel,
        ladder: Ladder,
        on_pose: OnPose | None = None,
        calibration: Calibration | None = None,
        extrapolate_s: float = EXTRAPOLATE_S,
        more: Sequence[ObservationModel] = (),
    ) -> None:
        """`more`: of further objects that may be felt, which the ladder has as well. `on_pose` is
        called with every accepted sensor pose (t, x, y, θ), as the robot sends it. `calibration`:
        of the skin and its mount on the robot. `extrapolate_s`: as of PoseTrack."""
        config = calibrated(config, calibration)
        self.config = config
        self.calibration = calibration
        self.ladder = ladder
        period_s = config.source.period_ms / 1000.0
        silent_s = max(SCAN_AGE_S, SILENT_PERIODS * period_s)
        self.skin = Skin(
            model.layout, config.skin, silent_s, calibration, noise=noise_of(config.filter)
        )
        self.poses: PoseTrack | StandingStill = StandingStill()
        if config.sensor_pose.endpoint:
            mount = None if calibration is None else calibration.mount
            self.poses = PoseTrack(on_pose, mount, extrapolate_s)
        others = [Known(one, ladder.of(k)) for k, one in enumerate(more, 1)]
        robot_m, most = config.sensor_pose.sigma_m, config.scene.max_objects
        self.estimator = Estimator(model, ladder, config.filter, robot_m, others, most)
        self._judge_by(self.estimator.estimate.object)
        self._learns = config.skin.learn and config.filter.motion == "none"
        square = config.filter.centre_m, config.filter.half_width_m
        self.freshness = Freshness(silent_s, *square, max(map(_reach_m, [model, *more])))
        self.estimate = self.freshness.judged(self.estimator.estimate)
        self.inputs = InputCounters()
        self.thinks_at_once = True  # whether a scan's second opinion is part of the work on it
        self._waiting: deque[tuple[float, Scan]] = deque()  # scans with their times of arrival
        self._stepped_s = 0.0  # total steps of the Unix clock since start [s]

    def advance(self, scans: Iterable[Scan], now: float) -> Iterator[Outcome]:
        """Take the scans that have arrived by `now`; the sensor poses that have are already added.
        → outcomes of these scans, and of scans that had been waiting.

        A scan waits for a pose at or after its time, which may be on its way, but no longer than
        `sensor_pose.wait_s`.
        """
        by = self._stepped_s
        for scan in scans:
            age = now - scan.t
            if -FUTURE_S <= age <= SCAN_AGE_S:
                self._waiting.append((now - by, later(scan, -by)))
                self.inputs.scans_waited += not self.poses.reaches(scan.t)
            else:
                yield self._refused(age)
        while self._waiting and self._is_due(*self._waiting[0], now - by):
            yield self._take(self._waiting.popleft()[1])

    def flush(self) -> Iterator[Outcome]:
        """Outcomes of the scans that still wait, as nothing more will come."""
        while self._waiting:
            yield self._take(self._waiting.popleft()[1])

    @property
    def has_waiting(self) -> bool:
        """Whether a scan waits for a pose."""
        return bool(self._waiting)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do, and no scan waits."""
        is_due = self.check.is_due and self.estimator.unconsidered is not None
        return (is_due or self.estimator.has_thought) and not self._waiting

    def think(self) -> Outcome | None:
        """After a scan that told nothing new, take a step of the calibration's check, and a second
        opinion on the belief; → its estimate where that has changed, and the time of this work."""
        clock = self.ladder.clock
        start, proposed_ns = clock(), self.ladder.spent_ns
        if not self._consider():
            return None
        self.estimate = self.freshness.judged(replace(self.estimator.estimate, t=self.estimate.t))
        propose_ns = self.ladder.spent_ns - proposed_ns
        filter_ns = clock() - start - propose_ns
        return Outcome(self.estimate, propose_ns=propose_ns, filter_ns=filter_ns)

    def clock_stepped(self, by: float) -> None:
        """The Unix clock was set forward by `by` seconds.

        The sensor's poses are forgotten, because the robot's clock may or may not have been set as
        well.
        """
        self.inputs.clock_steps += 1
        self._stepped_s += by
        self.poses.clear()
        if self.estimate.t:  # the estimate is of a scan
            self.estimate = later(self.estimate, by)

    def input_counts(self) -> dict[str, int]:
        """Counts of scans and poses before their use; waiting ones are not counted yet."""
        return {
            **asdict(self.inputs),
            "scans_waiting": len(self._waiting),
            "poses": self.poses.taken,
            "poses_rejected": self.poses.rejected,
            "poses_far": self.poses.far,
            "poses_from_the_future": self.poses.from_the_future,
        }

    def health(self) -> dict[str, Any]:
        """Counters of the stages since start, and the taxels that cannot be believed."""
        counted = self.estimator.counters
        return {
            "skin": {**asdict(self.skin.counters), "lowered": self.skin.lowered},
            "estimator": {
                "scans": counted.scans,
                "updates": counted.updates,
                "stuck": counted.stuck,
                "jumps": counted.jumps,
                "forgotten": counted.forgotten,
            },
            "modules": {
                "layout": self.skin.modules,
                "foreign": len(self.skin.wiring.foreign),
                "match": self.freshness.is_whole,
            },
            "skin_fit": self.skin.fit.told(),
            **self.skin.faults(),
        }

    def skin_state(self) -> SkinState | None:
        """The skin's learned state in Unix time; None before there is any."""
        state = self.skin.state()
        return None if state is None else later(state, self._stepped_s)

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched. The status is STARTING until
        the baseline is learned."""
        self.skin.tare()
        self.freshness.last = Why.STARTING
        self.estimate = self.freshness.judged(self.estimate)

    def reset(self) -> None:
        """Forget all touches; samples are tried again as at start."""
        self._learn(LEAST_CONTACTS)
        self.ladder.begin_anew()
        self.estimator.reset()
        self.check.reset()
        self.estimate = self.freshness.judged(self.estimator.estimate)

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn again from what an earlier daemon has felt."""
        if scans:
            self.estimator.restore(scans)
            self.estimate = self.freshness.judged(self.estimator.estimate)

    def tell(self, pose: ToldPose, of: Sequence[int] | None = None) -> str:
        """Take a told pose of the objects numbered `of`, else of any; → why it cannot be taken,
        empty where it was, or says nothing new."""
        config = self.config
        if config.filter.injection != "mixture" or config.scene.max_objects > 1:
            return "prior: needs filter.injection = mixture and scene.max_objects = 1"
        if self.estimator.tell(pose, of):
            self.estimate = self.freshness.judged(later(self.estimator.estimate, self._stepped_s))
        return ""

    def _is_due(self, arrived: float, scan: Scan, now: float) -> bool:
        waited = now - arrived >= self.config.sensor_pose.wait_s
        has_pose = self.poses.reaches(scan.t + self._stepped_s)
        return waited or has_pose or len(self._waiting) > WAITING_MAX

    def _refused(self, age: float) -> Outcome:
        if age > 0.0:
            self.inputs.scans_old += 1
        else:
            self.inputs.scans_from_the_future += 1
        self.freshness.last = Why.SCANS_MISTIMED
        self.estimate = self.freshness.judged(self.estimate)
        return Outcome(self.estimate)

    def _take(self, scan: Scan) -> Outcome:
        """Work on a scan to its end; the sensor's poses up to its time have been added."""
        clock, by = self.ladder.clock, self._stepped_s
        start = clock()
        activation = self.skin.on_scan(scan)
        skin_ns = clock() - start
        self.freshness.is_whole = len(self.skin.wiring.lacking) <= self.config.skin.missing_modules
        if activation is None:
            self.freshness.last = Why.STARTING
            return self._unused(scan, skin_ns)
        sensor = self.poses.at(scan.t + by)
        if sensor is None:
            self.inputs.scans_without_pose += 1
            self.freshness.last = Why.NO_POSE
            return replace(self._unused(scan, skin_ns), activation=later(activation, by))
        self.freshness.last = Why.VALID
        start, proposed_ns = clock(), self.ladder.spent_ns
        believed = self.estimator.estimate
        if believed.object != self._judged:
            self._judge_by(believed.object)
        own = [mode for mode in believed.modes if mode.object == believed.object]
        estimate = self.estimator.learn(activation, sensor)
        self.check.on_scan(self.estimator.used, own, estimate.contacts)
        if self.thinks_at_once:
            self._consider()
            while self.estimator.is_behind:
                self.estimator.think()
            estimate = self.estimator.estimate
        propose_ns = self.ladder.spent_ns - proposed_ns
        filter_ns = clock() - start - propose_ns
        if not estimate.contact:
            self._learn(CONTACTS)
        self.estimate = self.freshness.judged(later(estimate, by))
        return Outcome(self.estimate, later(activation, by), sensor, skin_ns, propose_ns, filter_ns)

    def _judge_by(self, number: int) -> None:
        """Judge the calibration by touches of the object of this number, from now on."""
        model = self.estimator.known[number].model
        self._judged, self.check = number, CalibrationCheck(model, self.config.filter)

    def _learn(self, least: int) -> None:
        """Have a sure belief teach the skin, once it can tell of so many contacts more."""
        lesson = self.estimator.taught(least) if self._learns else None
        if lesson is not None:
            self.skin.teach(lesson)

    def _consider(self) -> bool:
        """Take a step of the check and a second opinion; → whether the estimate has changed."""
        if self.estimator.unconsidered is not None:
            self.check.step()
        return self.estimator.think()

    def _unused(self, scan: Scan, skin_ns: int) -> Outcome:
        """The outcome of a scan that did not reach the estimator."""
        t = scan.t + self._stepped_s
        self.estimate = self.freshness.judged(replace(self.estimate, t=t))
        return Outcome(self.estimate, skin_ns=skin_ns)


def _reach_m(model: ObservationModel) -> float:
    """How far from the link's axis an object may lie that touches it [m]."""
    return float(np.hypot(*model.scene.outline.T).max()) + model.layout.radius_m
