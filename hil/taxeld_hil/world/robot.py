"""The robot's path: around the object, in to a press, out again; poses by linear interpolation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.scenario import Scenario

TRAVEL_M_S = 0.25
APPROACH_M_S = 0.1
PRESS_M_S = 0.02
STANDOFF_M = 0.03  # between the skin and the object's farthest reach, while travelling
SLOW_FROM_M = 0.01  # before the touch
YAW_SPREAD_RAD = 0.5
BARE_RAD = 0.5 * np.pi  # a skin that leaves a wider arc of its link bare is turned to the object
ARC_STEP_RAD = 0.1
MARCH_M = 0.0005
TOUCH = 0.1  # least activation of a press: a corner between two columns may give none,
TRIES = 20  # places that are tried
LEAVE = 2  # waypoints from the end of a touch to where the way around the object goes on
AROUND = 8  # contacts, at most, to once around the object: any so many in turn see all of its sides


@dataclass(frozen=True, slots=True)
class RobotPath:
    """Waypoints of the sensor in the world, the yaw not wrapped; and how far off the robot takes
    itself to be at some times, in between by linear interpolation."""

    t: NDArray[np.float64]  # (W,) seconds from the start
    pose: Poses  # (W, 3)
    touched: Floats = field(default_factory=lambda: np.empty((0, 2)))  # (N, 2) begins and ends [s]
    off_m: Floats = field(default_factory=lambda: np.zeros((1, 2)))  # (K, 2) error in x and y
    off_t: Floats = field(default_factory=lambda: np.zeros(1))  # (K,)

    @property
    def end(self) -> Poses:
        x, y, theta = self.pose[-1]
        return np.array([x, y, se2.wrap(theta)])

    @property
    def duration_s(self) -> float:
        return float(self.t[-1])

    def at(self, t: float) -> Poses:
        if t >= self.duration_s:
            return self.end
        x, y, theta = (np.interp(t, self.t, column) for column in self.pose.T)
        return np.array([x, y, se2.wrap(np.float64(theta))])

    def stated(self, t: float) -> Poses:
        """The pose (3,) that the robot takes for its own."""
        off = [np.interp(t, self.off_t, column) for column in self.off_m.T]
        return np.asarray(self.at(t) + np.array([*off, 0.0]))

    def erring(self, sd_m: float, seed: int) -> "RobotPath":
        """The same path of a robot whose error is drawn for each touch, and lasts through it."""
        if not sd_m or not len(self.touched):
            return self
        off = np.random.default_rng([seed, 11]).normal(0.0, sd_m, (len(self.touched), 2))
        return replace(self, off_m=np.repeat(off, 2, axis=0), off_t=self.touched.ravel())


def plan(scenario: Scenario, model: ObservationModel, truth: Poses, seed: int) -> RobotPath:
    """A path that touches the object from all sides, in turn, at random offsets and depths; the
    object stands at `truth` (3,) in the world."""
    rng, scene, circle = np.random.default_rng(seed), model.scene, Circle(model, truth)
    share = depth_share(model)
    start = rng.uniform(-np.pi, np.pi)

    def draw() -> tuple[float, float]:
        depth_m = share * rng.uniform(scenario.press_min_m, scenario.press_max_m)
        return depth_m, rng.uniform(-0.7, 0.7) * scene.size

    poses: list[list[float]] = []
    times: list[float] = []
    now, yaw, before = 0.0, first_yaw(model.layout, start), start
    touched: list[tuple[float, float]] = []
    step = 2.0 * np.pi / min(scenario.contacts, AROUND)
    for k in range(scenario.contacts):
        angle = start + step * (k + rng.uniform(-0.3, 0.3))
        yaw_to = next_yaw(model.layout, angle, yaw, rng)
        line = circle.press(angle, yaw_to, draw)[:, :2]
        arc = arc_of(before, angle)
        around = circle.at(arc)
        legs = [(p, TRAVEL_M_S) for p in around] + [
            (line[0], TRAVEL_M_S),
            (line[1], APPROACH_M_S),
            (line[2], PRESS_M_S),
            (line[2], 0.0),
            (line[1], PRESS_M_S),
            (line[0], APPROACH_M_S),
            (around[-1], TRAVEL_M_S),
        ]
        for i, (point, speed) in enumerate(legs):
            gap = float(np.linalg.norm(point - poses[-1][:2])) if poses else 0.0
            now += gap / speed if speed else scenario.hold_s
            turned = yaw + (yaw_to - yaw) * min(1.0, i / len(arc))
            poses.append([*point, turned])
            times.append(now)
        touched.append((times[-6], times[-3]))  # from where it slows, in and out again
        yaw, before = yaw_to, angle
    return RobotPath(np.array(times), np.array(poses), np.array(touched))


def in_turn(paths: Sequence[RobotPath]) -> list[RobotPath]:
    """The paths of links that touch one after the other: while one is at it, the others stand where
    their last touch has ended. Nothing keeps links from passing through each other."""
    if len(paths) == 1:
        return list(paths)
    times: list[list[float]] = [[] for _ in paths]
    poses: list[list[Poses]] = [[] for _ in paths]
    touched: list[list[Floats]] = [[] for _ in paths]
    firsts, now = [0] * len(paths), 0.0
    for touch in range(max(len(path.touched) for path in paths)):
        for k, path in enumerate(paths):
            if touch >= len(path.touched):
                continue
            # back where it slowed before the touch: out from there takes two waypoints more
            out = int(np.searchsorted(path.t, path.touched[touch, 1], side="right")) - 1
            way = slice(firsts[k], out + LEAVE + 1)
            later = now - float(path.t[firsts[k]])
            times[k] += (path.t[way] + later).tolist()
            poses[k] += list(path.pose[way])
            touched[k].append(path.touched[touch] + later)
            firsts[k], now = out + LEAVE, times[k][-1]
    found = []
    for k, path in enumerate(paths):
        moved = replace(
            path, t=np.array(times[k]), pose=np.array(poses[k]), touched=np.array(touched[k])
        )
        errs = len(path.off_t) > 1
        found.append(replace(moved, off_t=moved.touched.ravel()) if errs else moved)
    return found


def first_yaw(layout: Layout, angle: float) -> float:
    """The yaw with which a path begins, at this angle around the object."""
    side = _side(layout)
    return 0.0 if side is None else angle + np.pi - side


def next_yaw(layout: Layout, angle: float, yaw: float, rng: np.random.Generator) -> float:
    """The yaw, not wrapped, of a touch from this angle around the object, after `yaw`. A skin all
    around its link drifts; one on a side of it turns that side to the object."""
    spread, side = rng.uniform(-YAW_SPREAD_RAD, YAW_SPREAD_RAD), _side(layout)
    if side is None:
        return float(yaw + spread)
    return float(yaw + se2.wrap(np.float64(angle + np.pi - side + spread - yaw)))


def _side(layout: Layout) -> float | None:
    """The middle [rad] of the arc that the taxels cover; None if they are all around the link."""
    angle = np.sort(np.arctan2(layout.position_m[:, 1], layout.position_m[:, 0]))
    bare = np.diff(angle, append=angle[0] + 2.0 * np.pi)
    widest = int(bare.argmax())
    return None if bare[widest] <= BARE_RAD else angle[widest] + 0.5 * bare[widest] - np.pi


def depth_share(model: ObservationModel) -> float:
    """Depth of this foam at full scale, as a share of the usual one: presses go in proportion."""
    return model.depth_max_m / SkinConfig().full_scale_depth_m


def arc_of(before: float, angle: float) -> Floats:
    """(A,) angles on the way from one to another, in small steps."""
    return np.linspace(before, angle, 2 + int(abs(angle - before) / ARC_STEP_RAD))


class Circle:
    """A circle clear of an object at `truth` (3,) in the world, on which approaches begin."""

    def __init__(self, model: ObservationModel, truth: Poses) -> None:
        self._model, self._truth = model, truth
        self._centre = se2.compose(truth, np.array([*model.scene.centre, 0.0]))[:2]
        self._radius_m = model.scene.size + model.layout.radius_m + STANDOFF_M

    def at(self, angle: float | Floats) -> Floats:
        """Points (…, 2) [m] at angles (…)."""
        return np.asarray(
            self._centre + self._radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        )

    def press(
        self,
        angle: float,
        yaw: float,
        draw: Callable[[], tuple[float, float]],
    ) -> Poses:
        """(3, 3) poses of a straight approach from an angle: where it begins, where it slows, where
        it presses. `draw` has a depth and how far it passes the centre by [m], and is asked again
        where a taxel would hardly be pressed."""
        for _ in range(TRIES):
            depth_m, offset_m = draw()
            line = self._approach(angle, offset_m, depth_m)
            poses = np.column_stack([line, np.full(3, yaw)])
            seen = se2.compose(se2.inverse(poses[2]), self._truth)
            if self._model.activation(seen[None]).max() > TOUCH:
                break
        return poses

    def _approach(self, angle: float, offset: float, depth: float) -> Floats:
        """(3, 2) points of an approach. An offset at which the sensor would miss the object is
        reduced."""
        model = self._model
        inwards = -np.array([np.cos(angle), np.sin(angle)])
        sideways = np.array([-inwards[1], inwards[0]])
        far = np.sqrt(max(self._radius_m**2 - offset**2, 0.0))
        way = np.arange(0.0, far, MARCH_M)
        points = self._centre + offset * sideways - far * inwards + way[:, None] * inwards
        sensor = np.column_stack([points, np.zeros(len(points))])
        seen = se2.compose(se2.inverse(sensor), self._truth[None])
        gap = contacts.clearance(model.scene, model.layout.radius_m, seen)
        deep = np.flatnonzero(gap < -depth)
        if not len(deep):
            return self._approach(angle, 0.7 * offset, depth)
        slow = np.flatnonzero(gap < SLOW_FROM_M)[0]
        return np.asarray(points[[0, slow, deep[0]]])
