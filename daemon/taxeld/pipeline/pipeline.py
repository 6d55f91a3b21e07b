"""From scans to estimates: skin, sensor pose and estimator in one pure object.

The daemon's loop and the replay of a session run this same code. Arrivals are handed in with their
times, so the same arrivals give the same estimates, byte for byte. Durations are measured by the
ladder's clock, if it has one.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from taxeld.advice.advice import Advice, Advisor
from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.estimator.rule import EstimatorCounters
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.advising import Advising
from taxeld.pipeline.calibrated import calibrated
from taxeld.pipeline.calibration_check import CalibrationCheck, CalibrationDoubt
from taxeld.pipeline.freshness import Freshness, Why
from taxeld.pipeline.outcome import InputCounters, Outcome, later
from taxeld.pipeline.poses import EXTRAPOLATE_S, OnPose, PoseTrack, StandingStill
from taxeld.pipeline.stage import SCAN_AGE_S, LinkStage
from taxeld.proposals.ladder import Ladder
from taxeld.skin.calibration import Calibration
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState
from taxeld.told import ToldPose
from taxeld_protocol.decoder import Scan

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
        calibration: Calibration | Sequence[Calibration | None] | None = None,
        extrapolate_s: float = EXTRAPOLATE_S,
        more: Sequence[ObservationModel] = (),
        on_poses: Sequence[OnPose | None] = (),
    ) -> None:
        """`more`: of further objects that may be felt, which the ladder has as well. `on_pose` is
        called with every accepted sensor pose (t, x, y, θ) of the first link, as the robot sends
        it, `on_poses` with those of the further ones. `calibration`: of the skin and its mount on
        the robot, or one for each link. `extrapolate_s`: as of PoseTrack."""
        given = calibration if isinstance(calibration, Sequence) else [calibration]
        each = [calibrated(config.of_link(k), one) for k, one in enumerate(given)]
        self.config = config = replace(each[0], links=config.links)
        self.ladder = ladder
        square = config.filter.centre_m, config.filter.half_width_m
        reach_m = max(_reach_m(link) for one in [model, *more] for link in one.links)
        silent_s = [max(SCAN_AGE_S, SILENT_PERIODS * one.source.period_ms / 1e3) for one in each]
        self.freshness = Freshness(max(silent_s), *square, reach_m, len(each))
        self.stages = [
            LinkStage(
                one,
                link.layout,
                s,
                fresh,
                [on_pose, *on_poses][k] if k <= len(on_poses) else None,
                given[k],
                extrapolate_s,
            )
            for k, (one, link, s, fresh) in enumerate(
                zip(each, model.links, silent_s, self.freshness.links, strict=True)
            )
        ]
        others = [Known(one, ladder.of(k), ladder.beside(one)) for k, one in enumerate(more, 1)]
        robot_m, most = config.sensor_pose.sigma_m, config.scene.max_objects
        beside = ladder.beside(model)
        self.estimator = Estimator(model, ladder, config.filter, robot_m, others, most, beside)
        self._judge_by(self.estimator.estimate.object)
        advisor = Advisor(self.estimator, config.advice) if config.advice.enabled else None
        self._advising = Advising(advisor, [stage.poses.mount for stage in self.stages])
        self._learns = config.skin.learn and config.filter.motion == "none"
        self.estimate = self.freshness.judged(self.estimator.estimate)
        self.thinks_at_once = True  # whether a scan's second opinion is part of the work on it
        self._stepped_s = 0.0  # total steps of the Unix clock since start [s]

    def advance(
        self, scans: Iterable[Scan], now: float, *further: Iterable[Scan]
    ) -> Iterator[Outcome]:
        """Take the scans that have arrived by `now`, of the first link and of each of the
        `further`; the sensor poses that have are already added. → outcomes of these scans, and of
        scans that had been waiting.

        A scan waits for a pose at or after its time, which may be on its way, but no longer than
        `sensor_pose.wait_s`; and for earlier scans of other links that wait.
        """
        for number, came in enumerate((scans, *further)):
            for scan in came:
                if self.stages[number].arrive(scan, now, self._stepped_s) is not None:
                    self.estimate = self.freshness.judged(self.estimate)
                    yield Outcome(self.estimate, link=number)
        while self.has_waiting and self._next().is_due(now - self._stepped_s, self._stepped_s):
            yield self._take(self._next())

    def flush(self) -> Iterator[Outcome]:
        """Outcomes of the scans that still wait, as nothing more will come."""
        while self.has_waiting:
            yield self._take(self._next())

    @property
    def has_object(self) -> bool:
        """Whether an object is known; else the skin is served alone."""
        return True

    @property
    def advice(self) -> Advice | None:
        """Where to touch next; None while the belief changes, and where that is not enabled."""
        return self._advising.advice

    @property
    def counted(self) -> EstimatorCounters:
        """Counters of the estimator, since start."""
        return self.estimator.counters

    @property
    def doubt(self) -> CalibrationDoubt:
        """The doubt that touches raise about the calibration."""
        return self.check.doubt

    @property
    def skin(self) -> Skin:
        """The first link's skin."""
        return self.stages[0].skin

    @property
    def poses(self) -> PoseTrack | StandingStill:
        """The poses of the first link's sensor."""
        return self.stages[0].poses

    @property
    def inputs(self) -> InputCounters:
        """Counters of the first link's inputs."""
        return self.stages[0].inputs

    @property
    def has_waiting(self) -> bool:
        """Whether a scan waits for a pose."""
        return any(stage.waiting for stage in self.stages)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do, and no scan waits."""
        return (self._has_opinion or self._advising.has_work) and not self.has_waiting

    def think(self) -> Outcome | None:
        """After a scan that told nothing new, take a step of the calibration's check, and a second
        opinion on the belief; → its estimate where that has changed, and the time of this work.
        Where there is neither, do a piece of work on advice."""
        if not self._has_opinion:
            self._advising.step()
            return None
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
        self._stepped_s += by
        for stage in self.stages:
            stage.inputs.clock_steps += 1
            stage.poses.clear()
        if self.estimate.t:  # the estimate is of a scan
            self.estimate = later(self.estimate, by)

    def health(self) -> dict[str, Any]:
        """Counters of the estimator, and of the first link's skin, since start."""
        counted = self.counted
        return {
            "estimator": {
                "scans": counted.scans,
                "updates": counted.updates,
                "stuck": counted.stuck,
                "jumps": counted.jumps,
                "forgotten": counted.forgotten,
            },
            **self.stages[0].health(),
        }

    def skin_state(self, link: int = 0) -> SkinState | None:
        """What the skin of a link has learned, in Unix time; None before there is anything."""
        return self.stages[link].state(self._stepped_s)

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched. The status is STARTING until
        the baseline is learned."""
        for stage in self.stages:
            stage.tare()
        self.estimate = self.freshness.judged(self.estimate)

    def reset(self) -> None:
        """Forget all touches; samples are tried again as at start."""
        self._learn(LEAST_CONTACTS)
        self.ladder.begin_anew()
        self.estimator.reset()
        self.check.reset()
        self._advising.changed()
        self.estimate = self.freshness.judged(self.estimator.estimate)

    def _next(self) -> LinkStage:
        """The link whose first waiting scan is the earliest of all links'."""
        if len(self.stages) == 1:
            return self.stages[0]
        waiting = (stage for stage in self.stages if stage.waiting)
        return min(waiting, key=lambda stage: stage.waiting[0][1].t)

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn again from what an earlier daemon has felt."""
        if scans:
            self.estimator.restore(scans)
            self._advising.changed()
            self.estimate = self.freshness.judged(self.estimator.estimate)

    def tell(self, pose: ToldPose, of: Sequence[int] | None = None) -> str:
        """Take a told pose of the objects numbered `of`, else of any; → why it cannot be taken,
        empty where it was, or says nothing new."""
        config = self.config
        if config.filter.injection != "mixture" or config.scene.max_objects > 1:
            return "prior: needs filter.injection = mixture and scene.max_objects = 1"
        if self.estimator.tell(pose, of):
            self._advising.changed()
            self.estimate = self.freshness.judged(later(self.estimator.estimate, self._stepped_s))
        return ""

    def _take(self, stage: LinkStage) -> Outcome:
        """Work on a link's first waiting scan to its end; the sensor's poses up to its time have
        been added."""
        clock, by, link = self.ladder.clock, self._stepped_s, self.stages.index(stage)
        scan = stage.waiting.popleft()[1]
        start = clock()
        activation = stage.skin.on_scan(scan)
        skin_ns = clock() - start
        lacking = len(stage.skin.wiring.lacking)
        stage.fresh.is_whole = lacking <= stage.config.skin.missing_modules
        if activation is None:
            stage.fresh.last = Why.STARTING
            return self._unused(scan, skin_ns, link)
        sensor = stage.poses.at(scan.t + by)
        if sensor is None:
            stage.inputs.scans_without_pose += 1
            stage.fresh.last = Why.NO_POSE
            return replace(self._unused(scan, skin_ns, link), activation=later(activation, by))
        stage.fresh.last = Why.VALID
        spent_ns = skin_ns, *self._believe(activation, sensor, link)
        return Outcome(self.estimate, later(activation, by), sensor, *spent_ns, link)

    @property
    def _has_opinion(self) -> bool:
        """Whether there is a step of the check, or a second opinion, to take."""
        is_due = self.check.is_due and self.estimator.unconsidered is not None
        return is_due or self.estimator.has_thought

    def _believe(self, activation: Activation, sensor: Poses, link: int) -> tuple[int, int]:
        """Learn from a link's activation at its sensor's pose (3,); → the time that samples took,
        and that all the rest took [ns]."""
        clock = self.ladder.clock
        start, proposed_ns = clock(), self.ladder.spent_ns
        believed = self.estimator.estimate
        if believed.object != self._judged:
            self._judge_by(believed.object)
        own = [mode for mode in believed.modes if mode.object == believed.object]
        estimate = self.estimator.learn(activation, sensor, link)
        if not link:  # a full scale or mount in doubt is the first link's
            self.check.on_scan(self.estimator.used, own, estimate.contacts)
        has_learned = estimate.log_evidence != 0.0 or estimate.objects != believed.objects
        told, moves = estimate.contact or has_learned, self.estimator.used is not None
        self._advising.on_scan(sensor, link, told=told, moves=moves)
        if self.thinks_at_once:
            self._consider()
            while self.estimator.is_behind:
                self._consider()
            while self._advising.has_work:
                self._advising.step()
            estimate = self.estimator.estimate
        propose_ns = self.ladder.spent_ns - proposed_ns
        filter_ns = clock() - start - propose_ns
        if not estimate.contact:
            self._learn(CONTACTS)
        self.estimate = self.freshness.judged(later(estimate, self._stepped_s))
        return propose_ns, filter_ns

    def _judge_by(self, number: int) -> None:
        """Judge the calibration by touches of the object of this number, from now on."""
        model = self.estimator.known[number].model
        self._judged, self.check = number, CalibrationCheck(model, self.config.filter)

    def _learn(self, least: int) -> None:
        """Have a sure belief teach the skins, once it can tell of so many contacts more."""
        for number, stage in enumerate(self.stages if self._learns else ()):
            lesson = self.estimator.taught(least, number)
            if lesson is not None:
                stage.skin.teach(lesson)

    def _consider(self) -> bool:
        """Take a step of the check and a second opinion; → whether the estimate has changed."""
        if self.estimator.unconsidered is not None:
            self.check.step()
        has_changed = self.estimator.think()
        if has_changed:
            self._advising.changed()
        return has_changed

    def _unused(self, scan: Scan, skin_ns: int, link: int) -> Outcome:
        """The outcome of a scan that did not reach the estimator."""
        t = scan.t + self._stepped_s
        self.estimate = self.freshness.judged(replace(self.estimate, t=t))
        return Outcome(self.estimate, skin_ns=skin_ns, link=link)


def _reach_m(model: ObservationModel) -> float:
    """How far from the link's axis an object may lie that touches it [m]."""
    return float(np.hypot(*model.scene.outline.T).max()) + model.layout.radius_m
