"""Trials: a seeded sequence of touches of an object, as the estimator meets them.

Each touch has a random side and depth; `motion` has the way to it and from it. Wire and skin
processing are left out, so that thousands of trials are affordable. Each taxel has a gain of its
own, the same throughout a trial. `Conditions` add what else may be amiss. They draw from a
generator of their own, so a seed has the same touches under all conditions but those that choose
among touches.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld_training.filters import motion
from taxeld_training.filters.conditions import (
    Conditions,
    Side,
    TrialSkin,
    Twin,
    nudged,
    places,
    reported,
)

PLACE_M = 0.15  # the object is within ± this of the origin, at any yaw
MIN_ACTIVATION = 0.1  # least activation of the strongest taxel in a press
BATCH, PAIR_BATCH = 64, 4096  # poses drawn to choose presses from
BATCHES_MAX = 1000  # batches of poses before a trial is given up

Accepts = Callable[[Poses], NDArray[np.bool_]]


class Moment(NamedTuple):
    """One scan of a trial."""

    touch: int  # index of the touch it belongs to
    activation: Activation
    sensor: Poses  # (3,) in the world, as the robot reports it
    truth: Poses  # (3,) of the object in the world
    twin: Poses | None = None  # (3,) of a second object of the same kind


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
        extra = np.random.default_rng((self.seed, 1))  # for what the conditions add
        start = _placed(rng)
        skin = TrialSkin(given, model.layout, given.gains(len(model.layout), rng), extra)
        truths = places(given, start, self.touches, extra)
        if given.kidnapped_after:
            truths[given.kidnapped_after :] += _placed(extra) - start
        twin = Twin(model, extra) if given.both else None
        wanted = self._presses(twin, rng, extra)
        t = 0.0
        before = _opposite(wanted[0])
        moved = se2.IDENTITY  # motion by the presses so far, in the object's frame
        for touch, (press, place) in enumerate(zip(wanted, truths, strict=True)):
            nudge = nudged(given, model, press, extra)
            slips = given.slip_m * extra.standard_normal((given.scans, 3)) * (1.0, 1.0, 0.0)
            error = extra.standard_normal(3)
            steps = motion.touch(press, model, given, slips)
            for step in (*motion.around(model, before, steps[0].pose, twin), *steps):
                t += step.after_s
                truth = se2.compose(place, se2.compose(moved, step.gave * nudge))
                h = model.activation(step.pose[None])[0]
                if twin is not None:
                    h = np.maximum(h, twin.activation(step.pose[None])[0])
                reading = skin.read(h, t, (touch + 1) / self.touches, rng)
                sensor = reported(given, se2.compose(truth, se2.inverse(step.pose)), error)
                twin_pose = None if twin is None else se2.compose(truth, twin.pose)
                yield Moment(touch, reading, sensor, truth, twin_pose)
            before, moved = step.pose, se2.compose(moved, nudge)

    def _presses(
        self, twin: Twin | None, rng: np.random.Generator, extra: np.random.Generator
    ) -> Poses:
        """(touches, 3) presses as the conditions demand them."""
        model, given, count = self.model, self.conditions, self.touches
        if given.one_side:
            return presses(model, count, rng, given.depth, Side(model, extra).accepts)
        if twin is None:
            return presses(model, count, rng, given.depth)

        way = np.array(motion.APPROACH_M)

        def clear(poses: Poses, depth_m: float) -> NDArray[np.bool_]:
            """(N,) whether the approach, too, presses the twin no deeper."""
            kept = twin.is_clear(poses, depth_m)
            kept[kept] = [
                bool(twin.is_clear(motion.along(model, pose, way), depth_m).all())
                for pose in poses[kept]
            ]
            return kept

        def alone(poses: Poses) -> NDArray[np.bool_]:
            return clear(poses, 0.0)

        def both(poses: Poses) -> NDArray[np.bool_]:
            pressed = twin.activation(poses).max(axis=1) > MIN_ACTIVATION
            pressed[pressed] = clear(poses[pressed], given.depth * model.depth_max_m)
            return np.asarray(pressed)

        found = presses(model, count, rng, given.depth, alone)
        pairs = presses(model, given.both, extra, given.depth, both, PAIR_BATCH)
        found[extra.permutation(count)[: given.both]] = pairs
        return found


def presses(
    model: ObservationModel, count: int, rng: np.random.Generator, depth: float = 1.0,
    accepts: Accepts | None = None, batch: int = BATCH,
) -> Poses:  # fmt: skip
    """(count, 3) poses of the object in the sensor frame that press the skin up to `depth` δ_max
    deep and that `accepts` lets pass.

    Raises:
        SetupError: such poses hardly exist.
    """
    found = np.empty((0, 3))
    deepest_m = depth * model.depth_max_m
    for _ in range(BATCHES_MAX):
        made = contacts.synthesise(model.scene, model.layout.radius_m, deepest_m, batch, rng)
        pose = made.pose[model.activation(made.pose).max(axis=1) > MIN_ACTIVATION]
        found = np.concatenate([found, pose if accepts is None else pose[accepts(pose)]])
        if len(found) >= count:
            return found[:count]
    raise SetupError("a trial's touches hardly exist: the skin misses the object there")


def _placed(rng: np.random.Generator) -> Poses:
    most = np.array([PLACE_M, PLACE_M, np.pi])
    return np.asarray(rng.uniform(-most, most))


def _opposite(press: Poses) -> Poses:
    """Where the robot comes from first: a press (3,) with the object turned by half a turn."""
    return se2.compose(se2.rotation_about(press[:2], np.pi), press)
