"""Whether the touches of a session agree with the skin's full scale and mount.

Either hardly shows in one touch: the belief takes it for a slightly other pose. It shows over
several, as the object does not move with the sensor. So the touches are fitted twice: by the
object's pose alone, and by that pose with a factor on all readings and an offset of the mount. A
value is wrong where the second fit is far likelier and its factor or offset is large.
"""

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
from taxeld_hil.rules import Rule, at_least, require

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
MOUNT_MOST_M, YAW_MOST_DEG = 0.002, 2.0
CERTAIN_NATS = 22.0  # a rough skin imitates a wrong mount by up to 20


def of_session(directory: Path, config: Config) -> list[Rule]:
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
    estimate, cure = pipeline.estimate, "touch the object from more sides"
    found = [
        at_least("touches", "touches", len(touches), LEAST_TOUCHES, cure),
        at_least("touches", "p", estimate.p, LEAST_P, cure, ".0%"),
    ]
    require(found, str(directory))
    model = pipeline.estimator.known[estimate.object].model
    return found + _rules(model, [*touches.values()], estimate.map, noise_of(config.filter))


def _rules(
    model: ObservationModel, touches: list[Observation], where: Poses, noise: Noise
) -> list[Rule]:
    """The rules on K touches of an object about the pose `where` (3,). Parameters of a fit are
    (7,): log scale, mount, and the object's shift."""
    z, live = np.array([one.z for one in touches]), np.array([one.live for one in touches])
    floor = np.array([one.floor + 0.0 * one.z for one in touches])
    residue = np.array([one.residue + 0.0 * one.z for one in touches])
    sensor = np.array([one.sensor for one in touches])

    def errors(x: Floats) -> Floats:
        """(K, M) in standard deviations; 0 where a reading tells nothing of what is expected."""
        seen = se2.compose(se2.inverse(se2.compose(sensor, x[1:4])), where + x[4:])
        h = np.exp(x[0]) * model.activation(seen)
        within = np.minimum(h, 1.0)
        own = ONSET_SD * deviation(within)
        sd = np.sqrt(noise.variance(within) + own**2 + residue**2)
        told = live & ~((z >= 1.0) & (h >= 1.0)) & ~((z == 0.0) & (h <= floor))
        return np.asarray(np.where(told, (z - h) / sd, 0.0))

    def residuals(x: Floats) -> Floats:
        return np.concatenate([errors(x).ravel(), x / PRIOR_SD])

    def nats(x: Floats) -> Floats:
        """The robust cost (K,) of each touch."""
        return np.asarray((np.hypot(1.0, errors(x)) - 1.0).sum(axis=1))

    fits = [least_squares(residuals, x, loss="soft_l1").x for x in STARTS]
    free = min(fits, key=lambda x: float(nats(x).sum()))
    fixed = np.zeros(4)
    own = least_squares(lambda q: residuals(np.r_[fixed, q]), np.zeros(3), loss="soft_l1").x
    gains = nats(np.r_[fixed, own]) - nats(free)
    gained = float(gains.sum() - gains.max())  # without the touch that gains most
    scale, (x, y, yaw) = float(np.exp(free[0])), free[1:4] * [1.0, 1.0, np.degrees(1.0)]
    is_off = abs(np.log(scale)) > np.log(SCALE_MOST)
    is_far = np.hypot(x, y) > MOUNT_MOST_M or abs(yaw) > YAW_MOST_DEG
    is_sure = gained >= CERTAIN_NATS
    likelier = f"likelier by {gained:.0f} nats"
    limit = f"{1e3 * MOUNT_MOST_M:g} mm, {YAW_MOST_DEG:g}°, {CERTAIN_NATS:.0f} nats"
    cure = "full scale or mount is wrong, and few touches do not tell which: calibrate again"
    said = f"x {1e3 * x:+.1f} mm, y {1e3 * y:+.1f} mm, yaw {yaw:+.1f}°, {likelier}"
    factor, most = f"× {scale:.2f}, {likelier}", f"× {SCALE_MOST:g}, {CERTAIN_NATS:.0f} nats"
    return [
        Rule("fit", "full scale", factor, most, not (is_off and is_sure), cure),
        Rule("fit", "mount", said, limit, not (is_far and is_sure), cure),
    ]
