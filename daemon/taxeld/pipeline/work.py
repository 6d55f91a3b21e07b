"""The estimator's work on one scan, which may be left after each of its parts and taken up
again."""

from taxeld.arrays import Poses
from taxeld.config.tables import Config
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.proposals.ladder import Ladder


class Work:
    """On the activation of a scan, at the sensor's pose (3,) in the world."""

    def __init__(
        self,
        estimator: Estimator,
        ladder: Ladder,
        activation: Activation,
        sensor: Poses,
        skin_ns: int = 0,
    ) -> None:
        """`skin_ns`: what the skin took for it."""
        self.activation = activation
        self.sensor = sensor
        self.skin_ns = skin_ns
        self.own_ns = 0  # so far, on the ladder's clock; without the time between parts
        self.parts = self.longest_ns = 0  # of it
        self.is_told = False  # whether its estimate has been made known
        self._estimator = estimator
        self._before = estimator.estimate
        self._ladder = ladder
        self._parts = estimator.parts(activation, sensor)
        self._proposed_ns = ladder.spent_ns
        self._left_ns: int | None = None

    @property
    def estimate(self) -> Estimate:
        """The scan's, or the one before it."""
        return self._estimator.estimate

    @property
    def has_estimate(self) -> bool:
        """Whether it is the scan's; thoughts that follow may better it."""
        return self.estimate is not self._before

    @property
    def propose_ns(self) -> int:
        """Of the time, what proposals took."""
        return self._ladder.spent_ns - self._proposed_ns

    def go_on(self) -> bool:
        """Do the next part; → whether it was the last, or all was forgotten."""
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
        """The estimator is about to forget all."""
        self._parts.close()
        self._ladder.given_up()


def estimator_of(model: ObservationModel, ladder: Ladder, config: Config) -> Estimator:
    """As configured."""
    return Estimator(model, ladder, config.filter, config.sensor_pose.sigma_m)
