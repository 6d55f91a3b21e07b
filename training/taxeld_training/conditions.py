"""What may be amiss while an estimator works: skin, robot and world as it does not assume them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld import contacts, se2
from taxeld.observation import ObservationModel
from taxeld.se2 import Poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SILENT = 4.0  # standard deviations of noise below which a reading is silence
MODULE = 10  # taxels
SIDE_RAD = np.pi / 4.0  # a side reaches this far both ways
BESIDE_M = 0.01  # gap between the object and another one beside it
APART_STEP_M = 0.002


@dataclass(frozen=True)
class Conditions:
    """Of a trial; the defaults are what the estimator assumes."""

    sigma: float = 0.02  # sd of an activation
    gain_cv: float = 0.17  # spread of the taxels' gains
    dead_share: float = 0.0  # of the taxels, scattered, known to be dead
    dead_modules: int = 0  # runs of ten taxels, known to be dead
    stuck: int = 0  # taxels that always read `stuck_at`, and are believed
    stuck_at: float = 1.0
    drift: float = 0.0  # most that a taxel's baseline has gone, up or down, by the last touch
    depth: float = 1.0  # of the deepest press, in δ_max
    sensor_sd_m: float = 0.0  # of the sensor's pose as reported, another error each touch
    sensor_sd_rad: float = 0.0
    kidnapped_after: int = 0  # touches, then the object is put elsewhere; 0: never
    pushed_m: float = 0.0  # between two touches, all along one line
    pushed_rad: float = 0.0
    both: int = 0  # touches in which another such object, beside it, is pressed as well
    one_side: bool = False  # all touches within a quarter of the directions around the object
    scans: int = 3  # of a press
    slip_m: float = 0.0  # sd of the sensor's place in each of them


class Skin:
    """The faults of one skin, which last throughout a trial."""

    def __init__(self, given: Conditions, gain: Floats, rng: np.random.Generator) -> None:
        taxels = len(gain)
        self._given = given
        self._gain = gain
        self._offset = given.drift * rng.uniform(-1.0, 1.0, taxels)
        self._stuck = rng.permutation(taxels)[: given.stuck]
        self.live = np.ones(taxels, dtype=np.bool_)
        self.live[rng.permutation(taxels)[: round(given.dead_share * taxels)]] = False
        for module in rng.permutation(-(-taxels // MODULE))[: given.dead_modules]:
            self.live[module * MODULE : (module + 1) * MODULE] = False

    def read(self, h: Floats, elapsed: float, rng: np.random.Generator) -> Floats:
        """Activations z (M,) of true ones, after a share `elapsed` of the trial."""
        given = self._given
        z = self._gain * h + elapsed * self._offset + given.sigma * rng.standard_normal(len(h))
        z = np.where(z < SILENT * given.sigma, 0.0, np.minimum(z, 1.0))
        z[self._stuck] = given.stuck_at
        return np.where(self.live, z, 0.0)


def places(given: Conditions, start: Poses, touches: int, rng: np.random.Generator) -> Poses:
    """(touches, 3) where an object pushed in between stands during each touch."""
    along, turned = rng.uniform(-np.pi, np.pi), rng.choice([-1.0, 1.0])
    step = [
        given.pushed_m * np.cos(along), given.pushed_m * np.sin(along), turned * given.pushed_rad
    ]  # fmt: skip
    return np.asarray(start + np.arange(touches)[:, None] * np.array(step))


def reported(given: Conditions, sensor: Poses, error: Poses) -> Poses:
    """What the robot says of the sensor's pose, with this touch's error in standard deviations."""
    sd = np.array([given.sensor_sd_m, given.sensor_sd_m, given.sensor_sd_rad])
    return sensor + sd * error if sd.any() else sensor


class Side:
    """Presses from one side of the object."""

    def __init__(self, model: ObservationModel, rng: np.random.Generator) -> None:
        self._centre = model.scene.centre
        self.angle = float(rng.uniform(-np.pi, np.pi))

    def accepts(self, poses: Poses) -> Bools:
        """(N,) whether the skin stands on that side of the object at `poses` (N, 3)."""
        ax, ay = contacts.axis_in_object(poses)
        angle = np.arctan2(ay - self._centre[1], ax - self._centre[0])
        return np.asarray(np.abs(se2.wrap(angle - self.angle)) <= SIDE_RAD)


class Beside:
    """Another object of the same kind, close to the first."""

    def __init__(self, model: ObservationModel, rng: np.random.Generator) -> None:
        self._model = model
        direction, yaw = rng.uniform(-np.pi, np.pi, 2)
        self.pose = _beside(model, direction, yaw)  # in the first one's frame

    def activation(self, poses: Poses) -> Floats:
        """(N, M) what is felt of it with the first one at `poses` (N, 3) in the sensor frame."""
        return self._model.activation(se2.compose(poses, self.pose))

    def is_clear(self, poses: Poses, depth_m: float) -> Bools:
        """(N,) whether the link presses it no deeper than `depth_m`."""
        seen = se2.compose(poses, self.pose)
        gap = contacts.clearance(self._model.scene, self._model.layout.radius_m, seen)
        return np.asarray(gap >= -depth_m)


def _beside(model: ObservationModel, direction: float, yaw: float) -> Poses:
    """The farthest place in a direction at which an object turned by `yaw` stands `BESIDE_M` off
    the one at the origin."""
    scene = model.scene
    outline = se2.apply(np.array([0.0, 0.0, yaw]), scene.outline - scene.centre)
    along = np.array([np.cos(direction), np.sin(direction)])
    apart = np.arange(2.0 * scene.size + 2.0 * BESIDE_M, 0.0, -APART_STEP_M)
    points = outline + scene.centre + apart[:, None, None] * along
    gap = scene.clearance(points[..., 0], points[..., 1])[0].min(axis=1)
    centre = scene.centre + apart[int((gap <= BESIDE_M).argmax())] * along
    corner = centre - se2.apply(np.array([0.0, 0.0, yaw]), scene.centre[None])[0]
    return np.array([*corner, yaw])
