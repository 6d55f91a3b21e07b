"""From scans to estimates: skins, sensor poses and belief in one pure object.

The daemon's loop and the replay of a session run this same code. Arrivals are handed in with their
times, so the same arrivals give the same bytes on one machine and one build. Durations are measured
by the samples' clock, if they have one.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate, Hypotheses, ProposalKind, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.estimator.rule import EstimatorCounters
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.pipeline.calibrated import calibrated
from taxeld.pipeline.freshness import Freshness, Why
from taxeld.pipeline.outcome import InputCounters, Outcome, later
from taxeld.pipeline.poses import EXTRAPOLATE_S, OnPose, PoseTrack, StandingStill
from taxeld.pipeline.stage import SCAN_AGE_S, LinkStage
from taxeld.prior import PosePrior
from taxeld.proposals.samples import Samples
from taxeld.skin.calibration import Calibration
from taxeld.skin.skin import Skin
from taxeld.skin.state import SkinState
from taxeld_protocol.decoder import Scan

SILENT_PERIODS = 3.0  # scan periods without a scan: a hub is silent, all is stale
NO_OBJECT = "there is no object (scene.bundle is empty)"
CONTACTS, LEAST_CONTACTS = 12, 4  # contacts of a lesson, and of one before all is forgotten
NOTHING = Estimate(  # without an object: it carries the status of the inputs, and is not published
    t=0.0,
    status=Status.SEARCHING,
    contact=False,
    contacts=0,
    map=se2.IDENTITY,
    mean=se2.IDENTITY,
    cov=np.zeros((3, 3)),
    modes=(),
    p=0.0,
    radius_m=0.0,
    hypotheses=Hypotheses(0.0, 0.0, 1.0),
    object=0,
    objects=(),
    ess=0.0,
    particles=0,
    injected=0,
    proposal=ProposalKind.NONE,
    log_evidence=0.0,
)


class Pipeline:
    """Scans and sensor poses in, outcomes out.

    Times are Unix times outside, also those of the sensor's poses. The skin, the belief and waiting
    scans use a time without the steps of the Unix clock: Unix time less `_stepped_s`.
    """

    def __init__(
        self,
        config: Config,
        layouts: Sequence[Layout],
        objects: Sequence[ObservationModel],
        samples: Samples,
        on_poses: Sequence[OnPose] = (),
        calibration: Sequence[Calibration | None] = (),
        extrapolate_s: float = EXTRAPOLATE_S,
    ) -> None:
        """`layouts` of each link; `objects` that may be felt, which the samples are of: without
        any the skin is served alone. `on_poses` are called with every accepted sensor pose
        (t, x, y, θ) of each link, as the robot sends it. `calibration`: of each link's skin and its
        mount on the robot. `extrapolate_s`: as of PoseTrack."""
        given = calibration or [None] * len(layouts)
        each = [calibrated(config.of_link(k), one) for k, one in enumerate(given)]
        self.config = config = replace(each[0], links=config.links)
        self.samples = samples
        square = config.filter.centre_m, config.filter.half_width_m
        reach_m = max((_reach_m(link) for one in objects for link in one.links), default=0.0)
        silent_s = [max(SCAN_AGE_S, SILENT_PERIODS * one.source.period_ms / 1e3) for one in each]
        self.freshness = Freshness(max(silent_s), *square, reach_m, len(each))
        self.stages = [
            LinkStage(
                one,
                layouts[k],
                silent_s[k],
                self.freshness.links[k],
                on_poses[k] if on_poses else None,
                given[k],
                extrapolate_s,
            )
            for k, one in enumerate(each)
        ]
        self._learns = config.skin.learn and config.filter.motion == "none"
        self._estimator: Estimator | None = None  # None: without an object
        if objects:
            self._estimator = estimator_of(config, objects, samples)
        self.estimate = self.freshness.judged(self._believed)
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
    def estimator(self) -> Estimator:
        """Of the objects, of which there is one at least."""
        assert self._estimator is not None  # noqa: S101
        return self._estimator

    @property
    def has_object(self) -> bool:
        """Whether there is an object, and so an estimator."""
        return self._estimator is not None

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
    def is_touched(self) -> bool:
        """Whether a skin is."""
        return any(stage.skin.touched for stage in self.stages)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do, and no scan waits."""
        if self._estimator is None or self.has_waiting:
            return False
        return self._estimator.has_thought

    def think(self) -> Outcome | None:
        """Think as `Estimator.think` does; → the estimate where that has changed, and the time of
        this work."""
        if self._estimator is None:
            return None
        began = self._clocks()
        if not self._estimator.think():
            return None
        self.estimate = self.freshness.judged(replace(self._believed, t=self.estimate.t))
        return Outcome(self.estimate, None, None, 0, *self._spent_since(*began))

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
        counted = EstimatorCounters() if self._estimator is None else self._estimator.counters
        return {"estimator": asdict(counted), **self.stages[0].health()}

    def skin_state(self, link: int = 0) -> SkinState | None:
        """What the skin of a link has learned, in Unix time; None before there is anything."""
        return self.stages[link].state(self._stepped_s)

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched. The status is STARTING until
        the baseline is learned."""
        for stage in self.stages:
            stage.tare()
        self.estimate = self.freshness.judged(self.estimate)

    def reset(self) -> str:
        """Forget all touches; → why that cannot be done, empty where it was."""
        if self._estimator is None:
            return f"{NO_OBJECT}, so there is nothing to forget"
        self._teach(LEAST_CONTACTS)
        self.samples.begin_anew()
        self._estimator.reset()
        self.estimate = self.freshness.judged(self._believed)
        return ""

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn again from what an earlier daemon has felt."""
        if scans and self._estimator is not None:
            self._estimator.restore(scans)
            self.estimate = self.freshness.judged(self._believed)

    def tell(self, pose: PosePrior, of: Sequence[int] | None = None) -> str:
        """Take a prior of the objects numbered `of`, else of any; → why it cannot be taken, empty
        where it was."""
        if self._estimator is None:
            return NO_OBJECT
        if self.config.filter.injection != "mixture":
            return "prior: needs filter.injection = mixture"
        before = self._believed
        self._estimator.tell(pose, of)
        if self._believed is not before:
            self.estimate = self.freshness.judged(later(self._believed, self._stepped_s))
        return ""

    def _teach(self, least: int) -> None:
        """Have a sure belief teach the skins, once it can tell of so many contacts more."""
        for number, stage in enumerate(self.stages if self._learns else ()):
            lesson = self.estimator.taught(least, number)
            if lesson is not None:
                stage.skin.teach(lesson)

    @property
    def _believed(self) -> Estimate:
        """The estimate of the belief, whatever became of the inputs since."""
        return NOTHING if self._estimator is None else self._estimator.estimate

    def _next(self) -> LinkStage:
        """The link whose first waiting scan is the earliest of all links'."""
        if len(self.stages) == 1:
            return self.stages[0]
        waiting = (stage for stage in self.stages if stage.waiting)
        return min(waiting, key=lambda stage: stage.waiting[0][1].t)

    def _take(self, stage: LinkStage) -> Outcome:
        """Work on a link's first waiting scan to its end; the sensor's poses up to its time have
        been added."""
        clock, by, link = self.samples.clock, self._stepped_s, self.stages.index(stage)
        scan = stage.waiting.popleft()[1]
        late_s = stage.pace.late_s(scan.ihb, scan.t)
        start = clock()
        activation = stage.skin.on_scan(scan)
        skin_ns = clock() - start
        lacking = len(stage.skin.wiring.lacking)
        stage.fresh.is_whole = lacking <= stage.config.skin.missing_modules
        if activation is None:
            stage.fresh.last = Why.STARTING
            return self._unused(scan, skin_ns, link)
        sensor, sd_m = stage.poses.at(scan.t + by), stage.poses.sd_m(scan.t + by, late_s)
        if sensor is None or sd_m > stage.config.filter.within_m:
            stage.inputs.scans_without_pose += 1
            stage.fresh.last = Why.NO_POSE
            return replace(self._unused(scan, skin_ns, link), activation=later(activation, by))
        stage.fresh.last = Why.VALID
        activation = replace(activation, place_sd_m=sd_m)
        spent_ns = self._believe(activation, sensor, link)
        return Outcome(self.estimate, later(activation, by), sensor, skin_ns, *spent_ns, link)

    def _believe(self, activation: Activation, sensor: Poses, link: int) -> tuple[int, int]:
        """Learn from a link's activation at its sensor's pose (3,); → the time that samples took,
        and that all the rest took [ns]."""
        if self._estimator is None:
            felt = replace(NOTHING, t=activation.t, contact=self.is_touched)
            self.estimate = self.freshness.judged(later(felt, self._stepped_s))
            return 0, 0
        began = self._clocks()
        if self.thinks_at_once:
            self._estimator.on_scan(activation, sensor, link)
        else:
            self._estimator.learn(activation, sensor, link)
        spent_ns = self._spent_since(*began)
        if not self._believed.contact:
            self._teach(CONTACTS)
        self.estimate = self.freshness.judged(later(self._believed, self._stepped_s))
        return spent_ns

    def _clocks(self) -> tuple[int, int]:
        """The time now, and all that samples have taken since start [ns]."""
        return self.samples.clock(), self.samples.spent_ns

    def _spent_since(self, start_ns: int, proposed_ns: int) -> tuple[int, int]:
        """The time that samples took since these clocks, and that all the rest took [ns]."""
        now_ns, spent_ns = self._clocks()
        propose_ns = spent_ns - proposed_ns
        return propose_ns, now_ns - start_ns - propose_ns

    def _unused(self, scan: Scan, skin_ns: int, link: int) -> Outcome:
        """The outcome of a scan that did not reach the estimator."""
        t = scan.t + self._stepped_s
        self.estimate = self.freshness.judged(replace(self.estimate, t=t))
        return Outcome(self.estimate, skin_ns=skin_ns, link=link)


def estimator_of(
    config: Config, objects: Sequence[ObservationModel], samples: Samples
) -> Estimator:
    """The estimator of the objects, of which `samples` are."""
    first, *more = objects
    others = [Known(one, samples.of(k), samples.beside(one)) for k, one in enumerate(more, 1)]
    robot_m, own, beside = config.sensor_pose.sigma_m, samples.of(0), samples.beside(first)
    return Estimator(first, own, config.filter, robot_m, others, beside)


def _reach_m(model: ObservationModel) -> float:
    """How far from the link's axis an object may lie that touches it [m]."""
    return float(np.hypot(*model.scene.outline.T).max()) + model.layout.radius_m
