"""A robot that follows advice: its path grows by an approach at a time.

It touches as a real one does: straight ahead until something is touched, then as deep as advised.
Its way round to where an approach begins is its own: it knows where the object stands.
"""

import numpy as np

from taxeld.advice import lines
from taxeld.advice.advice import Advice, Approach
from taxeld.advice.lines import Lines
from taxeld.arrays import Floats, Poses
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.world import robot
from taxeld_hil.world.robot import RobotPath

Leg = tuple[Floats, float]  # a point (2,) that is reached at a speed [m/s], 0: the robot holds


def line_of(approach: Approach) -> Lines:
    """The line of an approach, as far as it goes without a touch."""
    far = float(np.linalg.norm(approach.until[:2] - approach.before[:2]))
    begin, direction = approach.before[None], np.array([approach.direction])
    return Lines(approach.link, begin, direction, np.array([far]))


class AdvisedRobot:
    """A robot beside an object that stands still."""

    def __init__(self, model: ObservationModel, truth: Poses, hold_s: float, seed: int) -> None:
        """`truth` (3,): the object's pose in the world; `hold_s`: how long a press is held."""
        self._model, self._truth, self._hold_s = model, truth, hold_s
        self._contacts, self._tried = -1, list[Poses]()  # approaches since so many contacts
        self._centre = se2.compose(truth, np.array([*model.scene.centre, 0.0]))[:2]
        self._circle = model.scene.reach + model.layout.radius_m + robot.STANDOFF_M
        angle = np.random.default_rng(seed).uniform(-np.pi, np.pi)
        start = [*self._around(self._circle, angle), robot.first_yaw(model.layout, angle)]
        self.path = RobotPath(np.zeros(1), np.array([start]))

    def best(self, advice: Advice) -> Approach:
        """The best approach that was not tried since the last contact."""
        if advice.contacts != self._contacts:
            self._contacts, self._tried = advice.contacts, []
        new = (one for one in advice.approaches if not self._has_tried(one))
        found = next(new, advice.approaches[0])
        self._tried.append(found.before)
        return found

    def _has_tried(self, one: Approach) -> bool:
        return any(np.allclose(one.before, was) for was in self._tried)

    def follow(self, approach: Approach, begin_s: float) -> None:
        """Go along an approach and back to where it began, from `begin_s` on, after all before."""
        path, line = self.path, self._line(approach)
        hold = [(line[-1], 0.0), (line[1], robot.PRESS_M_S)] if len(line) > 2 else []
        slow = robot.PRESS_M_S if hold else robot.APPROACH_M_S
        way = self._way(path.end[:2], line[0])
        legs: list[Leg] = [(point, robot.TRAVEL_M_S) for point in way]
        legs += [(point, robot.APPROACH_M_S) for point in line[1:2]]
        legs += [(point, slow) for point in line[2:]]
        legs += [*hold, (line[0], robot.APPROACH_M_S if hold else robot.TRAVEL_M_S)]
        points = np.array([path.end[:2], *(point for point, _ in legs)])
        gap = np.linalg.norm(np.diff(points, axis=0), axis=1)
        speeds = np.array([speed for _, speed in legs])
        took = np.where(speeds > 0.0, gap / np.maximum(speeds, 1e-9), self._hold_s)
        times = begin_s + np.cumsum([0.0, *took])
        yaw = path.pose[-1, 2]
        turn = float(se2.wrap(approach.before[2] - yaw)) * np.minimum(
            np.arange(len(points)) / len(way), 1.0
        )
        self.path = RobotPath(
            np.concatenate([path.t, times]),
            np.vstack([path.pose, np.column_stack([points, yaw + turn])]),
            np.vstack([path.touched, [times[len(way)], times[-1]]]),
        )

    def _line(self, approach: Approach) -> Floats:
        """Points of a straight approach: where it begins, where it slows and where it presses; of a
        miss where it begins and where it ends."""
        line = line_of(approach)
        touched = float(lines.travel(line, self._model, self._truth[None])[0, 0])
        if not np.isfinite(touched):
            return np.array([approach.before[:2], approach.until[:2]])
        moments = [0.0, max(touched - robot.SLOW_FROM_M, 0.0), touched + approach.depth_m]
        return line.after_each(np.array(moments))[:, :2]

    def _way(self, begin: Floats, end: Floats) -> Floats:
        """Points (W, 2) from one place to another, around the object."""
        (r0, a0), (r1, a1) = map(self._polar, (begin, end))
        radius = max(self._circle, r0, r1)
        turn = float(se2.wrap(np.float64(a1 - a0)))
        arc = a0 + np.linspace(0.0, turn, 2 + int(abs(turn) / robot.ARC_STEP_RAD))
        return np.vstack([self._around(radius, arc), end])

    def _polar(self, point: Floats) -> tuple[float, float]:
        x, y = point - self._centre
        return float(np.hypot(x, y)), float(np.arctan2(y, x))

    def _around(self, radius: float, angle: float | Floats) -> Floats:
        return np.asarray(self._centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
