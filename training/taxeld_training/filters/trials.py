"""Trials: a seeded sequence of touches of an object, as the estimator meets them.

Each touch has a random side and depth. Between touches the skin is carried around the object. Then
it approaches along the contact's normal, presses deeper and deeper, holds, is released as it was
pressed, and backs off. Free motion is scanned less often than contact, as little happens in it.
Wire and skin processing are left out, so that thousands of trials are affordable.

Each taxel has a gain of its own, the same throughout a trial. `TrialConditions` add what else may
be amiss. They draw from a generator of their own, so a seed has the same touches under all
conditions but those that choose among touches.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from taxeld.advice.advice import Approach
from taxeld.advice.lines import travel
from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld_hil.world.advised import line_of
from taxeld_training.filters.conditions import (
    Accepts,
    TrialConditions,
    TrialSkin,
    Twin,
    nudged,
    on_one_side,
    places,
    reported,
)

PLACE_M = 0.15  # the object is within ± this of the origin, at any yaw
MIN_ACTIVATION = 0.1  # least activation of the strongest taxel in a press
BATCH, PAIR_BATCH = 64, 4096  # poses that are drawn at once, to choose presses from
BATCHES_MAX = 1000  # batches of poses before a trial is given up

SCAN_S = 0.05  # time between two scans near the object
FREE_S = 0.2  # time between two scans on the way around it
APPROACH_M = (0.03, 0.02, 0.01, 0.002)  # clearances before a press
RETREAT_M = (0.002, 0.01, 0.03)  # clearances after a press
PRESSING = (0.25, 0.5, 0.75)  # shares of the press's depth, before it is held
RELEASING = (0.67, 0.33)
FREE = 6  # scans on the way around
STEP_M = 0.01  # way between two scans of an advised approach
CLEAR_M = 0.03  # least clearance on the way around


Guide = Callable[[int], Approach | None]
"""Number of a touch → how it is approached; None: by a press that knows where the object is."""


class TrialScan(NamedTuple):
    """One scan of a trial."""

    touch: int  # index of its touch
    activation: Activation
    sensor: Poses  # (3,) in the world, as the robot reports it
    truth: Poses  # (3,) of the object in the world
    twin: Poses | None = None  # (3,) of a second object of the same kind
    link: int = 0  # of several links: which touches


class Waypoint(NamedTuple):
    """Where the skin is in one scan."""

    pose: Poses  # (3,) of the object in the sensor frame
    after_s: float  # time since the scan before
    gave: float  # share of the way that the object gives in to this touch


@dataclass(frozen=True)
class Trial:
    """`touches` presses of the object of `model`."""

    model: ObservationModel
    seed: int
    touches: int = 8
    conditions: TrialConditions = field(default_factory=TrialConditions)
    guide: Guide | None = None  # None: each press knows where the object is

    def __iter__(self) -> Iterator[TrialScan]:
        model, given = self.model, self.conditions
        rng = np.random.default_rng(self.seed)
        extra = np.random.default_rng((self.seed, 1))  # draws for the conditions
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
            approach = self.guide and self.guide(touch)
            if approach is None:
                steps = way_of(press, model, given, slips)
            else:
                nudge = se2.IDENTITY
                steps = advised(approach, model, se2.compose(place, moved), slips)
            for step in (*around(model, before, steps[0].pose, twin), *steps):
                t += step.after_s
                truth = se2.compose(place, se2.compose(moved, step.gave * nudge))
                h = model.activation(step.pose[None])[0]
                if twin is not None:
                    h = np.maximum(h, twin.activation(step.pose[None])[0])
                reading = skin.read(h, t, (touch + 1) / self.touches, rng)
                sensor = reported(given, se2.compose(truth, se2.inverse(step.pose)), error)
                twin_pose = None if twin is None else se2.compose(truth, twin.pose)
                yield TrialScan(touch, reading, sensor, truth, twin_pose)
            before, moved = step.pose, se2.compose(moved, nudge)

    def _presses(
        self, twin: Twin | None, rng: np.random.Generator, extra: np.random.Generator
    ) -> Poses:
        """(touches, 3) presses as the conditions demand them."""
        model, given, count = self.model, self.conditions, self.touches
        if given.one_side:
            return presses(model, count, rng, given.depth, on_one_side(model, extra))
        if twin is None:
            return presses(model, count, rng, given.depth)

        way = np.array(APPROACH_M)

        def clear(poses: Poses, depth_m: float) -> Bools:
            """(N,) whether the approach to poses (N, 3), too, presses the twin no deeper."""
            kept = twin.is_clear(poses, depth_m)
            kept[kept] = [
                bool(twin.is_clear(along(model, pose, way), depth_m).all()) for pose in poses[kept]
            ]
            return kept

        def alone(poses: Poses) -> Bools:
            """(N,) whether the twin stays untouched at poses (N, 3)."""
            return clear(poses, 0.0)

        def both(poses: Poses) -> Bools:
            """(N,) whether the twin is pressed too at poses (N, 3), no deeper than it may be."""
            pressed = twin.activation(poses).max(axis=1) > MIN_ACTIVATION
            pressed[pressed] = clear(poses[pressed], given.depth * model.depth_max_m)
            return np.asarray(pressed)

        found = presses(model, count, rng, given.depth, alone)
        pairs = presses(model, given.both, extra, given.depth, both, PAIR_BATCH)
        found[extra.permutation(count)[: given.both]] = pairs
        return found


def presses(
    model: ObservationModel,
    count: int,
    rng: np.random.Generator,
    depth: float = 1.0,
    accepts: Accepts | None = None,
    batch: int = BATCH,
) -> Poses:
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


def way_of(
    press: Poses, model: ObservationModel, given: TrialConditions, slips: Poses
) -> list[Waypoint]:
    """From the approach to a press (3,) until it is over; `slips` (scans, 3) while it is held."""
    depth_m = -float(contacts.clearance(model.scene, model.layout.radius_m, press[None])[0])
    before = np.concatenate([APPROACH_M, -depth_m * np.array(PRESSING)])
    after = np.concatenate([-depth_m * np.array(RELEASING), RETREAT_M])
    gave = np.concatenate([np.zeros(len(APPROACH_M)), PRESSING])
    return [
        *(
            Waypoint(pose, SCAN_S, share)
            for pose, share in zip(along(model, press, before), gave.tolist(), strict=True)
        ),
        *(Waypoint(pose, SCAN_S, 1.0) for pose in press + slips[: given.scans]),
        *(Waypoint(pose, SCAN_S, 1.0) for pose in along(model, press, after)),
    ]


def advised(
    approach: Approach, model: ObservationModel, truth: Poses, slips: Poses
) -> list[Waypoint]:
    """From the beginning of an approach to an object at `truth` (3,), in the world, until the touch
    is over; or to the approach's end, where it misses. The object stands. `slips` as of `way_of`.
    """
    line = line_of(approach)
    way = float(travel(line, model, truth[None])[0, 0])
    if np.isinf(way):
        moments = np.arange(0.0, line.length_m[0], STEP_M)
        slips = slips[:0]
    else:
        far = np.arange(0.0, max(way - STEP_M, 0.0), STEP_M)
        near = way - np.array([*APPROACH_M[-2:], *(-approach.depth_m * np.array(PRESSING))])
        moments = np.concatenate([far, near])
    back = way + np.concatenate([approach.depth_m * np.array(RELEASING), -np.array(RETREAT_M)])

    def at(travel_m: Floats) -> Poses:
        """(A, 3) poses of the object in the sensor frame after so much travel (A,)."""
        return se2.compose(se2.inverse(line.after_each(travel_m)), truth)

    held = at(np.full(1, way + approach.depth_m)) + slips if len(slips) else slips
    poses = [at(moments), held, at(back if len(slips) else moments[:0])]
    return [Waypoint(pose, SCAN_S, 0.0) for pose in np.concatenate(poses)]


def along(model: ObservationModel, press: Poses, clearance_m: Floats) -> Poses:
    """(A, 3) the press (3,) moved along the contact's normal until the skin is `clearance_m` (A,)
    from the object; negative: so deep."""
    ax, ay = contacts.axis_in_object(press[None])
    distance, gx, gy = model.scene.clearance(ax, ay)
    away = model.layout.radius_m - distance + clearance_m
    return contacts.pose_of_axis(ax + away * gx, ay + away * gy, press[2])


def around(
    model: ObservationModel, start: Poses, end: Poses, twin: Twin | None = None
) -> list[Waypoint]:
    """From one pose of the object in the sensor frame (3,) to another, clear of all objects."""
    scene = model.scene
    outline = scene.outline
    if twin is not None:
        outline = np.concatenate([outline, se2.apply(twin.pose, outline)])
    far = np.linalg.norm(outline - scene.centre, axis=1).max() + model.layout.radius_m + CLEAR_M
    ax, ay = contacts.axis_in_object(np.array([start, end]))
    first, last = np.arctan2(ay - scene.centre[1], ax - scene.centre[0])
    share = np.linspace(0.0, 1.0, FREE)
    angle = first + share * se2.wrap(last - first)
    x, y = scene.centre[:, None] + far * np.array([np.cos(angle), np.sin(angle)])
    turn = start[2] + share * se2.wrap(end[2] - start[2])
    return [Waypoint(pose, FREE_S, 0.0) for pose in contacts.pose_of_axis(x, y, turn)]


def _placed(rng: np.random.Generator) -> Poses:
    most = np.array([PLACE_M, PLACE_M, np.pi])
    return np.asarray(rng.uniform(-most, most))


def _opposite(press: Poses) -> Poses:
    """Where the robot comes from first: a press (3,) with the object turned by half a turn."""
    return se2.compose(se2.rotation_about(press[:2], np.pi), press)
