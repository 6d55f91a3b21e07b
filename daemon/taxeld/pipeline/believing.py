"""What is believed of the objects at each scan; sure beliefs teach the skins."""

from collections.abc import Sequence

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
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

    @property
    def estimate(self) -> Estimate:
        """The estimator's, at times without the steps of the Unix clock."""
        return self.estimator.estimate

    def on_scan(self, activation: Activation, sensor: Poses, link: int) -> None:
        """Learn from a link's activation at its sensor's pose (3,)."""
        self.estimator.learn(activation, sensor, link)

    def settle(self) -> None:
        """Take a second opinion, and do all work that the last touch has left."""
        self.estimator.think()
        while self.estimator.is_behind:
            self.estimator.think()

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

    def restore(self, scans: Sequence[Used]) -> None:
        """Learn again from what an earlier daemon has felt."""
        self.estimator.restore(scans)

    def tell(self, pose: PosePrior, of: Sequence[int] | None = None) -> str:
        """Take a prior of the objects numbered `of`, else of any; → why it cannot be taken, empty
        where it was."""
        if self._config.filter.injection != "mixture":
            return "prior: needs filter.injection = mixture"
        self.estimator.tell(pose, of)
        return ""
