"""From scans to estimates: skins, sensor poses and belief in one pure object.

The daemon's loop and the replay of a session run this same code. Arrivals are handed in with their
times, so the same arrivals give the same bytes on one machine and one build. Durations are measured
by the samples' clock, if they have one.
"""

import copy
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate, Hypotheses, ProposalKind, Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.news import EstimatorCounters
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.pipeline.freshness import Freshness
from taxeld.pipeline.poses import EXTRAPOLATE_S, PoseTrack
from taxeld.pipeline.stage import InputCounters, LinkStage, later
from taxeld.prior import PosePrior
from taxeld.proposals.samples import Samples
from taxeld.skin.calibration import Calibration
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import Scan

NO_OBJECT = "there is no object (scene.bundle is empty)"
CONTACTS, LEAST_CONTACTS = 12, 4  # contacts of a lesson, and of one before all is forgotten
WARM_UP_TOUCHES = 5
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


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one scan, and the time that each stage took [ns]."""

    estimate: Estimate
    activation: Activation | None = None  # None: baseline not known, or scan not used
    sensor: Poses | None = None  # (3,) sensor's pose in the world; None where not known
    skin_ns: int = 0
    propose_ns: int = 0
    filter_ns: int = 0
    link: int = 0  # number of the link whose scan it was

    @property
    def is_used(self) -> bool:
        """Whether the estimator has taken the scan."""
        return self.sensor is not None


class Pipeline:
    """Scans and sensor poses in, outcomes out.

    Times are Unix times outside, also those of the sensor's poses. The skin, the belief and waiting
    scans use a time without the steps of the Unix clock: Unix time less `stepped_s`.
    """

    def __init__(
        self,
        config: Config,
        layouts: Sequence[Layout],
        objects: Sequence[ObservationModel],
        samples: Samples,
        calibration: Sequence[Calibration | None] = (),
        extrapolate_s: float = EXTRAPOLATE_S,
    ) -> None:
        """`layouts` of each link; `objects` that may be felt, which the samples are of: without
        any the skin is served alone. `calibration`: of each link's skin and its mount on the
        robot. `extrapolate_s`: as of PoseTrack."""
        self.stages = [
            LinkStage(
                config.of_link(k),
                layout,
                calibration[k] if calibration else None,
                extrapolate_s,
            )
            for k, layout in enumerate(layouts)
        ]
        self.config = config = replace(self.stages[0].config, links=config.links)
        self.samples = samples
        self.freshness = Freshness(
            [stage.fresh for stage in self.stages],
            max(stage.silent_s for stage in self.stages),
            config.filter.centre_m,
            config.filter.half_width_m,
            max((_reach_m(link) for one in objects for link in one.links), default=0.0),
        )
        self._learns = config.skin.learn and config.filter.motion == "none"
        self._estimator: Estimator | None = None  # None: without an object
        if objects:
            known = [
                Known(one, samples.of(k), samples.beside(one)) for k, one in enumerate(objects)
            ]
            first, *more = known
            self._estimator = Estimator(
                first.model,
                first.proposal,
                config.filter,
                config.sensor_pose.sigma_m,
                more,
                first.beside,
            )
        self.thinks_at_once = True  # whether a scan's search is part of the work on it
        self.stepped_s = 0.0  # total steps of the Unix clock since start
        self._t = 0.0  # time of the last scan

    @property
    def estimate(self) -> Estimate:
        """The belief after the last scan, with the status that the inputs allow."""
        return self.estimate_at(None)

    def estimate_at(self, now_s: float | None) -> Estimate:
        """The same, with the monotonic time `now_s` also by the inputs' age."""
        t = self._t + self.stepped_s if self._t else 0.0
        if self._estimator is None:
            believed = replace(NOTHING, t=t, contact=self.is_touched)
        else:
            believed = self._estimator.estimate
            believed = believed if believed.t == t else replace(believed, t=t)
        return self.freshness.judged(believed, now_s)

    @property
    def estimator(self) -> Estimator:
        """Of the objects, of which there is one at least."""
        assert self._estimator is not None  # noqa: S101
        return self._estimator

    @property
    def has_object(self) -> bool:
        return self._estimator is not None

    @property
    def skin(self) -> Skin:
        """The first link's skin."""
        return self.stages[0].skin

    @property
    def poses(self) -> PoseTrack:
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
        return any(stage.skin.touched for stage in self.stages)

    def advance(self, scans: Iterable[Scan], now: float) -> Iterator[Outcome]:
        """Take the scans that have arrived by `now`; the sensor poses that have are already added.
        → outcomes of these scans, and of scans that had been waiting: of all of them where `now` is
        inf.

        A scan waits for a pose at or after its time, which may be on its way, but no longer than
        `sensor_pose.wait_s`; and for earlier scans of other links that wait.
        """
        for scan in scans:
            if not self.stages[scan.link].arrive(scan, now, self.stepped_s):
                yield Outcome(self.estimate, link=scan.link)
        while waiting := [stage for stage in self.stages if stage.waiting]:
            first = min(waiting, key=lambda stage: stage.waiting[0][1].t)
            if not first.is_due(now, self.stepped_s):
                return
            yield self._take(first)

    def _take(self, stage: LinkStage) -> Outcome:
        """Work on a link's first waiting scan to its end; the sensor's poses up to its time have
        been added."""
        clock, link = self.samples.clock, self.stages.index(stage)
        began_ns = clock()
        self._t, activation, sensor = stage.take(self.stepped_s)
        skin_ns = clock() - began_ns
        propose_ns = filter_ns = 0
        if activation is not None and sensor is not None and self._estimator is not None:
            began_ns, spent_ns = clock(), self.samples.spent_ns
            self._estimator.on_scan(activation, sensor, link, thinks=self.thinks_at_once)
            propose_ns = self.samples.spent_ns - spent_ns
            filter_ns = clock() - began_ns - propose_ns
            self._t = self._estimator.estimate.t
            if not self._estimator.estimate.contact:
                self._teach(CONTACTS)
        if activation is not None:
            activation = later(activation, self.stepped_s)
        spent = skin_ns, propose_ns, filter_ns
        return Outcome(self.estimate, activation, sensor, *spent, link)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do, and no scan waits."""
        return not self.has_waiting and self.has_object and self.estimator.has_thought

    def think(self) -> Outcome | None:
        """Search, as `Estimator.think` does; → the estimate where that has changed,
        and the time of this work."""
        began_ns, spent_ns = self.samples.clock(), self.samples.spent_ns
        if not self.estimator.think():
            return None
        propose_ns = self.samples.spent_ns - spent_ns
        filter_ns = self.samples.clock() - began_ns - propose_ns
        return Outcome(self.estimate, propose_ns=propose_ns, filter_ns=filter_ns)

    def clock_stepped(self, by: float) -> None:
        """The Unix clock was set forward by `by` seconds.

        The sensor's poses are forgotten, because the robot's clock may or may not have been set as
        well.
        """
        self.stepped_s += by
        for stage in self.stages:
            stage.inputs.clock_steps += 1
            stage.poses.clear()

    def health(self) -> dict[str, Any]:
        """Counters of the estimator and of the first link, since start."""
        counted = self._estimator.counters if self._estimator else EstimatorCounters()
        return {"estimator": asdict(counted), **self.stages[0].health()}

    def tare(self) -> None:
        """Learn the idle baseline anew; the skin must not be touched. The status is STARTING until
        the baseline is learned."""
        for stage in self.stages:
            stage.tare()

    def reset(self) -> str:
        """Forget all touches; → why that cannot be done, empty where it was."""
        if self._estimator is None:
            return f"{NO_OBJECT}, so there is nothing to forget"
        self._teach(LEAST_CONTACTS)
        self.samples.begin_anew()
        self._estimator.reset()
        return ""

    def take_prior(self, pose: PosePrior, of: Sequence[int] | None = None) -> str:
        """Take a prior of the objects numbered `of`, else of any; → why it cannot be taken, empty
        where it was."""
        if self._estimator is None:
            return NO_OBJECT
        if self.config.filter.injection != "mixture":
            return "prior: needs filter.injection = mixture"
        self._estimator.take_prior(pose, of)
        return ""

    def warm_up(self) -> None:
        """Let another belief in the same objects take a few touches of the first, so that code and
        memory are loaded before the first real one."""
        subject = copy.copy(self.estimator)
        subject.counters = EstimatorCounters()
        subject.reset()
        model, rng = subject.known[0].model, np.random.default_rng(0)
        pressing = contacts.synthesise(
            model.scene, model.layout.radius_m, model.depth_max_m, 8 * WARM_UP_TOUCHES, rng
        )
        live = np.ones(len(model.layout), dtype=np.bool_)
        for k, pose in enumerate(pressing.pose[:WARM_UP_TOUCHES]):
            pressed = model.activation(pose[None])[0]
            silent = 0.0 * pressed
            for after_s, z in ((0.0, pressed), (0.05, pressed), (0.1, silent), (0.5, silent)):
                subject.on_scan(Activation(k + after_s, z, live), se2.inverse(pose))

    def _teach(self, least: int) -> None:
        """Have a sure belief teach the skins, once it can tell of so many contacts more."""
        for number, stage in enumerate(self.stages if self._learns else ()):
            lesson = self.estimator.taught(least, number)
            if lesson is not None:
                stage.skin.teach(lesson)


def _reach_m(model: ObservationModel) -> float:
    """How far from the link's axis an object may lie that touches it [m]."""
    return float(np.hypot(*np.concatenate(model.scene.outlines).T).max()) + model.layout.radius_m
