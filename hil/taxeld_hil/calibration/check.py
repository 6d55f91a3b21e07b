"""Whether the touches of a session agree with the skin's full scale and mount.

Either hardly shows in one touch: the belief takes it for a slightly other pose. It shows over
several, as the object does not move with the sensor. So the touches are fitted twice: by the
object's pose alone, and by that pose with a factor on all readings and an offset of the mount. A
value is wrong where the second fit is far likelier and its factor or offset is large.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from taxeld.arrays import Floats, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.scans import noise_of
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.response import deviation

LEAST_TOUCHES = 5
FELT = 0.1  # share of full scale: noise and foam's residue touch more lightly
LEAST_P = 0.3  # at the end: under a wrong full scale an object is found, if not surely
PRIOR_SD = np.array([1.0, 0.01, 0.01, 0.15, 0.02, 0.02, 0.2])  # log scale, mount, object
ONSET_SD = 0.8  # sd of taxels' onsets, in units of `model.response.deviation` (docs/physics.md)
# starting values of the free fit: log scale and mount
STARTS = np.zeros((7, 7))
STARTS[:4, 0] = np.log([0.4, 0.7, 1.0, 2.5])
STARTS[3:, 1:3] = 0.006 * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
SCALE_MOST = 1.6  # responses of a skin differ in common by up to a third
MOUNT_MOST_M, YAW_MOST = 0.002, np.radians(2.0)
CERTAIN_NATS = 22.0  # a rough skin imitates a wrong mount by up to 20


@dataclass(frozen=True, slots=True)
class CalibrationCheck:
    """The two fits of one session."""

    touches: int
    scale: float  # factor on all readings
    mount: Poses  # (3,) offset of the sensor's frame: m, m, rad
    gained: float  # nats by which the second fit is likelier, without the touch that gains most

    @property
    def is_wrong(self) -> bool:
        """Whether full scale or mount is certainly wrong, and by much. Few touches do not tell
        which: a deeper reading may be either."""
        x, y, yaw = self.mount
        is_far = np.hypot(x, y) > MOUNT_MOST_M or abs(yaw) > YAW_MOST
        off = is_far or abs(np.log(self.scale)) > np.log(SCALE_MOST)
        return bool(off and self.gained >= CERTAIN_NATS)

    def lines(self) -> Iterator[str]:
        """The result in words."""
        x, y, yaw = self.mount
        yield f"touches    {self.touches}"
        yield f"full scale × {self.scale:.2f}"
        yield f"mount      x {1e3 * x:+.1f} mm, y {1e3 * y:+.1f} mm, yaw {np.degrees(yaw):+.1f}°"
        yield f"likelier   by {self.gained:.0f} nats; chance gives less than {CERTAIN_NATS:.0f}"
        yield "full scale or mount is wrong: calibrate again" if self.is_wrong else "both hold"


def of_session(directory: Path, config: Config) -> CalibrationCheck:
    """Replay a session and check its first link's values.

    Raises:
        SetupError: the session cannot be used, or its touches do not find the object.
    """
    pipeline = open_pipeline(directory, config)
    if not pipeline.has_object:
        raise SetupError("scene.bundle: is empty; the check needs the object that was touched")
    touches: dict[int, Observation] = {}
    for outcome in outcomes(directory, pipeline):
        used, number = pipeline.estimator.used, outcome.estimate.contacts
        if used is not None and not used.link and used.z.max() >= FELT:
            before = touches.get(number)
            if before is None or used.z.sum() > before.z.sum():
                touches[number] = used
    estimate = pipeline.estimate
    if len(touches) < LEAST_TOUCHES or estimate.p < LEAST_P:
        raise SetupError(
            f"{directory}: {len(touches)} touches with p {estimate.p:.0%} at the end; the check "
            f"needs {LEAST_TOUCHES} and p {LEAST_P:.0%}: touch the object from more sides"
        )
    model = pipeline.estimator.known[estimate.object].model
    return _Fits(model, [*touches.values()], estimate.map, noise_of(config.filter)).check()


class _Fits:
    """Both fits of K touches; parameters are (7,): log scale, mount, and the object's shift."""

    def __init__(
        self, model: ObservationModel, touches: list[Observation], where: Poses, noise: Noise
    ) -> None:
        self._model, self._where, self._noise = model, where, noise
        self._sensor = np.array([one.sensor for one in touches])
        self._z = np.array([one.z for one in touches])
        self._live = np.array([one.live for one in touches])
        ones = np.ones_like(self._z[0])
        self._floor = np.array([one.floor * ones for one in touches])
        self._residue = np.array([one.residue * ones for one in touches])

    def check(self) -> CalibrationCheck:
        tried = [least_squares(self._residuals, x, loss="soft_l1").x for x in STARTS]
        free = min(tried, key=lambda x: self._nats(x).sum())
        own = least_squares(
            lambda q: self._residuals(np.r_[np.zeros(4), q]), np.zeros(3), loss="soft_l1"
        ).x
        gained = self._nats(np.r_[np.zeros(4), own]) - self._nats(free)
        return CalibrationCheck(
            len(self._z), float(np.exp(free[0])), free[1:4], gained.sum() - gained.max()
        )

    def _expected(self, x: Floats) -> Floats:
        """Readings (K, M)."""
        mounted = se2.compose(self._sensor, x[1:4])
        seen = se2.compose(se2.inverse(mounted), self._where + x[4:])
        return np.asarray(np.exp(x[0]) * self._model.activation(seen))

    def _errors(self, x: Floats) -> Floats:
        """(K, M) in standard deviations; 0 where a reading tells nothing of what is expected."""
        h = self._expected(x)
        within = np.minimum(h, 1.0)
        own = ONSET_SD * deviation(within)
        sd = np.sqrt(self._noise.variance(within) + own**2 + self._residue**2)
        told = self._live & ~((self._z >= 1.0) & (h >= 1.0))
        told &= ~((self._z == 0.0) & (h <= self._floor))
        return np.asarray(np.where(told, (self._z - h) / sd, 0.0))

    def _residuals(self, x: Floats) -> Floats:
        return np.concatenate([self._errors(x).ravel(), x / PRIOR_SD])

    def _nats(self, x: Floats) -> Floats:
        """The robust cost (K,) of each touch."""
        return np.asarray((np.sqrt(1.0 + self._errors(x) ** 2) - 1.0).sum(axis=1))
