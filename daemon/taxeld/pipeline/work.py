"""The estimator's work on one scan, which may pause after each of its parts."""

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.proposals.ladder import Ladder


class Work:
    """Work on the activation of a scan, at the sensor's pose (3,) in the world."""

    def __init__(
        self,
        estimator: Estimator,
        ladder: Ladder,
        activation: Activation,
        sensor: Poses,
        skin_ns: int = 0,
    ) -> None:
        """`sensor` (3,): sensor's pose in the world; `skin_ns`: time that the skin took for the
        scan."""
        self.activation = activation
        self.sensor = sensor
        self.skin_ns = skin_ns
        self.own_ns = 0  # time so far on the ladder's clock, without pauses between parts
        self.parts = self.longest_ns = 0  # number of parts, and the longest
        self.is_told = False  # whether the estimate has been reported
        self._estimator = estimator
        self._before = estimator.estimate
        self._ladder = ladder
        self._parts = estimator.parts(activation, sensor)
        self._proposed_ns = ladder.spent_ns
        self._left_ns: int | None = None

    @property
    def estimate(self) -> Estimate:
        """The scan's estimate, or the one before it."""
        return self._estimator.estimate

    @property
    def has_estimate(self) -> bool:
        """Whether `estimate` is the scan's; later parts may improve it."""
        return self.estimate is not self._before

    @property
    def propose_ns(self) -> int:
        """The part of the time that proposals took."""
        return self._ladder.spent_ns - self._proposed_ns

    def go_on(self) -> bool:
        """Do the next part; → whether it was the last, or everything was forgotten."""
        begin = self._ladder.clock()
        if self._left_ns is not None:
            self._ladder.paused(begin - self._left_ns)
        try:
            next(self._parts)
        except StopIteration:
            self._ladder.used()
            return True
        finally:
            self._left_ns = self._ladder.clock()
            part_ns = self._left_ns - begin
            self.parts += 1
            self.longest_ns = max(self.longest_ns, part_ns)
            self.own_ns += part_ns
        return False

    def give_up(self) -> None:
        """Stop: the estimator is about to forget everything."""
        self._parts.close()
        self._ladder.given_up()


def estimator_of(model: ObservationModel, ladder: Ladder, config: Config) -> Estimator:
    """The configured estimator."""
    return Estimator(model, ladder, config.filter, config.sensor_pose.sigma_m)
