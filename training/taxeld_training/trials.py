"""Trials: a seeded sequence of touches of an object, as the estimator meets them.

Each touch comes from a random side and depth: the skin nears along the contact's normal, presses,
holds and leaves. Wire and skin processing are left out, so that thousands of trials are affordable;
taxels differ by a gain of their own, which stays the same throughout a trial. What else may be the
matter is said by `Conditions`, and drawn apart: the touches of a seed are the same under all of
those that do not choose among touches.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld import contacts, se2
from taxeld.errors import SetupError
from taxeld.observation import ObservationModel
from taxeld.se2 import Poses
from taxeld.skin import Activation
from taxeld_training.conditions import Beside, Conditions, Side, Skin, places, reported

Floats = NDArray[np.float64]

PLACE_M = 0.15  # the object stands within ± this of the origin, any yaw
FELT = 0.1  # presses that are felt less are not made
APPROACH_M = (0.03, 0.01, 0.002)  # clearances of the scans before a press
SCAN_S = 0.05
BETWEEN_S = 1.0  # touches
BATCH, PAIR_BATCH = 64, 4096  # poses drawn to choose presses from
BATCHES_MAX = 1000  # after which the presses asked for do not exist

Accepts = Callable[[Poses], NDArray[np.bool_]]


class Moment(NamedTuple):
    """One scan of a trial."""

    touch: int  # index of the touch it belongs to
    activation: Activation
    sensor: Poses  # (3,) in the world, as the robot reports it
    truth: Poses  # (3,) of the object in the world
    twin: Poses | None = None  # (3,) of another such object that is touched as well


@dataclass(frozen=True)
class Trial:
    """`touches` presses of the object of `model`."""

    model: ObservationModel
    seed: int
    touches: int = 8
    conditions: Conditions = field(default_factory=Conditions)

    def __iter__(self) -> Iterator[Moment]:
        model, given = self.model, self.conditions
        rng = np.random.default_rng(self.seed)
        odd = np.random.default_rng((self.seed, 1))  # what the conditions add
        start = _placed(rng)
        gain = np.maximum(1.0 + given.gain_cv * rng.standard_normal(len(model.layout)), 0.1)
        skin = Skin(given, gain, odd)
        truths = places(given, start, self.touches, odd)
        if given.kidnapped_after:
            truths[given.kidnapped_after :] += _placed(odd) - start
        beside = Beside(model, odd) if given.both else None
        wanted = self._presses(beside, rng, odd)
        t = 0.0
        for touch, (press, truth) in enumerate(zip(wanted, truths, strict=True)):
            path = approach(model, press)
            slips = given.slip_m * odd.standard_normal((given.scans, 3)) * (1.0, 1.0, 0.0)
            error = odd.standard_normal(3)
            twin = None if beside is None else se2.compose(truth, beside.pose)
            for pose in (*path, *(press + slips), path[-2]):
                h = model.activation(pose[None])[0]
                if beside is not None:
                    h = np.maximum(h, beside.activation(pose[None])[0])
                z = skin.read(h, (touch + 1) / self.touches, rng)
                sensor = reported(given, se2.compose(truth, se2.inverse(pose)), error)
                yield Moment(touch, Activation(t, z, skin.live), sensor, truth, twin)
                t += SCAN_S
            t += BETWEEN_S

    def _presses(
        self, beside: Beside | None, rng: np.random.Generator, odd: np.random.Generator
    ) -> Poses:
        """(touches, 3) of the kind that the conditions ask for."""
        model, given, count = self.model, self.conditions, self.touches
        if given.one_side:
            return presses(model, count, rng, given.depth, Side(model, odd).accepts)
        if beside is None:
            return presses(model, count, rng, given.depth)

        def clear(poses: Poses, depth_m: float) -> NDArray[np.bool_]:
            """Whether all of the way to the press leaves the other object in peace."""
            kept = beside.is_clear(poses, depth_m)
            kept[kept] = [
                bool(beside.is_clear(approach(model, pose), depth_m).all()) for pose in poses[kept]
            ]
            return kept

        def alone(poses: Poses) -> NDArray[np.bool_]:
            return clear(poses, 0.0)

        def both(poses: Poses) -> NDArray[np.bool_]:
            felt = beside.activation(poses).max(axis=1) > FELT
            felt[felt] = clear(poses[felt], given.depth * model.depth_max_m)
            return np.asarray(felt)

        found = presses(model, count, rng, given.depth, alone)
        pairs = presses(model, given.both, odd, given.depth, both, PAIR_BATCH)
        found[odd.permutation(count)[: given.both]] = pairs
        return found


def presses(
    model: ObservationModel, count: int, rng: np.random.Generator, depth: float = 1.0,
    accepts: Accepts | None = None, batch: int = BATCH,
) -> Poses:  # fmt: skip
    """(count, 3) poses of the object in the sensor frame at which it is felt, up to `depth` δ_max
    deep, and which `accepts` lets pass.

    Raises:
        SetupError: there are hardly any.
    """
    found = np.empty((0, 3))
    deepest_m = depth * model.depth_max_m
    for _ in range(BATCHES_MAX):
        made = contacts.synthesise(model.scene, model.layout.radius_m, deepest_m, batch, rng)
        felt = made.pose[model.activation(made.pose).max(axis=1) > FELT]
        found = np.concatenate([found, felt if accepts is None else felt[accepts(felt)]])
        if len(found) >= count:
            return found[:count]
    raise SetupError("a trial's touches hardly exist: the skin misses the object there")


def approach(model: ObservationModel, press: Poses) -> Poses:
    """Poses (A, 3) before the press: the skin backed off along the contact's normal."""
    ax, ay = contacts.axis_in_object(press[None])
    clearance, gx, gy = model.scene.clearance(ax, ay)
    away = model.layout.radius_m - clearance + np.array(APPROACH_M)
    ax, ay = ax + away * gx, ay + away * gy
    c, s = np.cos(press[2]), np.sin(press[2])
    return np.column_stack([s * ay - c * ax, -s * ax - c * ay, np.full(len(away), press[2])])


def _placed(rng: np.random.Generator) -> Poses:
    most = np.array([PLACE_M, PLACE_M, np.pi])
    return np.asarray(rng.uniform(-most, most))
