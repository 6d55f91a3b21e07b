"""What is thought of the objects at each scan: a belief, and advice.

Sure beliefs teach the skins.
"""

from collections.abc import Sequence

from taxeld.advice.advice import Advice, Advisor
from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.advising import Advising
from taxeld.pipeline.stage import LinkStage
from taxeld.prior import PosePrior
from taxeld.proposals.samples import Samples

CONTACTS, LEAST_CONTACTS = 12, 4  # contacts of a lesson, and of one before all is forgotten


class Believing:
    """An estimator of one object or several, and what depends on its belief."""

    def __init__(
        self,
        config: Config,
        objects: Sequence[ObservationModel],
        samples: Samples,
        stages: Sequence[LinkStage] = (),
    ) -> None:
        """`samples` are of each of the objects; the skins of `stages` are taught."""
        first, *more = objects
        others = [Known(one, samples.of(k), samples.beside(one)) for k, one in enumerate(more, 1)]
        robot_m, own, beside = config.sensor_pose.sigma_m, samples.of(0), samples.beside(first)
        self.estimator = Estimator(first, own, config.filter, robot_m, others, beside)
        self._config, self._samples, self._stages = config, samples, stages
        self._learns = config.skin.learn and config.filter.motion == "none"
        advisor = Advisor(self.estimator, config.advice) if config.advice.enabled else None
        self._advising = Advising(advisor, [stage.poses.mount for stage in stages])

    @property
    def estimate(self) -> Estimate:
        """The estimator's, at times without the steps of the Unix clock."""
        return self.estimator.estimate

    @property
    def advice(self) -> Advice | None:
        """Where to touch next; None while the belief changes, and where that is not enabled."""
        return self._advising.advice

    def on_scan(self, activation: Activation, sensor: Poses, link: int) -> None:
        """Learn from a link's activation at its sensor's pose (3,)."""
        believed = self.estimate
        estimate = self.estimator.learn(activation, sensor, link)
        has_learned = estimate.log_evidence != 0.0 or estimate.objects != believed.objects
        told, moves = estimate.contact or has_learned, self.estimator.used is not None
        self._advising.on_scan(sensor, link, told=told, moves=moves)

    @property
    def has_thought(self) -> bool:
        """Whether `think` has something to do."""
        return self.estimator.has_thought or self._advising.has_work

    def think(self) -> bool:
        """After a scan that told nothing new, take a second opinion on the belief; → whether the
        estimate has changed. Where there is none, do a piece of work on advice."""
        if not self.estimator.has_thought:
            self._advising.step()
            return False
        return self._consider()

    def settle(self) -> None:
        """Take a second opinion, and do all work that the last touch has left."""
        self._consider()
        while self.estimator.is_behind:
            self._consider()
        while self._advising.has_work:
            self._advising.step()

    def teach(self, least: int = CONTACTS) -> None:
        """Have a sure belief teach the skins, once it can tell of so many contacts more."""
        for number, stage in enumerate(self._stages if self._learns else ()):
            lesson = self.estimator.taught(least, number)
            if lesson is not None:
                stage.skin.teach(lesson)

    def reset(self) -> None:
        """Forget all touches; all samples are drawn again."""
        self.teach(LEAST_CONTACTS)
        self._samples.begin_anew()
        self.estimator.reset()
        self._advising.changed()

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn again from what an earlier daemon has felt."""
        self.estimator.restore(scans)
        self._advising.changed()

    def tell(self, pose: PosePrior, of: Sequence[int] | None = None) -> str:
        """Take a prior of the objects numbered `of`, else of any; → why it cannot be taken, empty
        where it was."""
        if self._config.filter.injection != "mixture":
            return "prior: needs filter.injection = mixture"
        self.estimator.tell(pose, of)
        self._advising.changed()
        return ""

    def _consider(self) -> bool:
        """Take a second opinion; → whether the estimate has changed."""
        has_changed = self.estimator.think()
        if has_changed:
            self._advising.changed()
        return has_changed
