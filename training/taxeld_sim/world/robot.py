"""The robot's path: around the object, in to a press, out again; poses by linear interpolation.

It grows touch by touch, so that what is touched next may depend on what was felt. Every touch is a
straight line, along which the robot slows before it presses. Its way around is its own: it knows
where the object stands.
"""

from dataclasses import dataclass, field

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import se2

TRAVEL_M_S = 0.25
APPROACH_M_S = 0.1
PRESS_M_S = 0.02
PUSH_M_S = 0.04
STANDOFF_M = 0.03  # between the skin and the object's farthest reach, while travelling
SLOW_FROM_M = 0.01  # before the touch
ARC_STEP_RAD = 0.1
SLIP_S = 0.05  # between two places of a sensor that slips

NO_TOUCH: Floats = np.empty((0, 2))


@dataclass(frozen=True, slots=True)
class RobotPath:
    """Waypoints of the sensor in the world, the yaw not wrapped; and how far off the robot takes
    itself to be at some times, in between by linear interpolation."""

    t: Floats  # (W,) seconds from the start
    pose: Poses  # (W, 3)
    tilt: Floats  # (W, 2) rotation vector of the lean, about the upright sensor's x and y [rad]
    touched: Floats = field(default_factory=NO_TOUCH.copy)  # (N, 2) begins and ends [s]
    off: Poses = field(default_factory=lambda: np.zeros((1, 3)))  # (K, 3) error of the pose
    off_t: Floats = field(default_factory=lambda: np.zeros(1))  # (K,)

    @property
    def duration_s(self) -> float:
        return float(self.t[-1])

    def at(self, t: Floats | float) -> Poses:
        """(…, 3) at times t (…)."""
        found = np.stack([np.interp(t, self.t, column) for column in self.pose.T], axis=-1)
        found[..., 2] = se2.wrap(found[..., 2])
        return found

    def turn(self, t: float) -> Floats:
        """(3, 3) of the link in the upright sensor's frame at time t."""
        return turned(np.array([np.interp(t, self.t, column) for column in self.tilt.T]))

    def stated(self, t: Floats | float) -> Poses:
        """The poses (…, 3) that the robot takes for its own at times t (…)."""
        off = [np.interp(t, self.off_t, column) for column in self.off.T]
        return np.asarray(self.at(t) + np.stack(off, axis=-1))


def turned(tilt: Floats) -> Floats:
    """(3, 3) of a rotation vector (2,) about x and y, by Rodrigues' formula."""
    x, y = tilt
    lean = float(np.hypot(x, y))
    across = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]]) / max(lean, 1e-12)
    return np.asarray(np.eye(3) + np.sin(lean) * across + (1.0 - np.cos(lean)) * across @ across)


class LinkRobot:
    """One link's robot, whose path grows."""

    def __init__(self, pose: Poses) -> None:
        """`pose` (3,): where it begins."""
        self._t, self._pose, self._touched = [0.0], [pose], list[list[float]]()
        self._tilt: list[Floats] = [np.zeros(2)]

    def path(self, sd_m: float, sd_rad: float, seed: int) -> RobotPath:
        """So far, of a robot whose error is drawn for each touch, and lasts through it."""
        t, pose, tilt = (np.array(each) for each in (self._t, self._pose, self._tilt))
        count = len(self._touched)
        if not count:
            return RobotPath(t, pose, tilt)
        touched = np.array(self._touched)
        place = np.random.default_rng([seed, 11]).normal(0.0, sd_m, (count, 2))
        turn = np.random.default_rng([seed, 12]).normal(0.0, sd_rad, (count, 1))
        off = np.repeat(np.hstack([place, turn]), 2, axis=0)
        return RobotPath(t, pose, tilt, touched, off, touched.ravel())

    @property
    def now(self) -> float:
        """When it has done all so far."""
        return self._t[-1]

    @property
    def pose(self) -> Poses:
        """(3,) where it then is, the yaw not wrapped."""
        return self._pose[-1]

    def wait(self, until: float) -> None:
        """Stand there until then."""
        self._t.append(max(until, self.now))
        self._pose.append(self.pose)
        self._tilt.append(self._tilt[-1])

    def travel(self, way: Floats, yaw: float, tilt: Floats) -> None:
        """Go along points (W, 2), and turn to `yaw` on the way by the shorter turn, and to a `tilt`
        (2,)."""
        was, leant = self.pose[2], self._tilt[-1]
        turn = se2.wrap(np.float64(yaw - was))
        for i, point in enumerate(way):
            self._go(np.array([*point, was + turn * i / len(way)]), TRAVEL_M_S)
            self._tilt[-1] = leant + (tilt - leant) * (i + 1) / len(way)

    def press(self, line: Poses, back: Poses, hold_s: float, slips: Poses) -> tuple[float, float]:
        """Go along a line (4, 3): where it begins, where it slows, where it touches, where it
        presses; and back by another, `back` (4, 3), to whose end it presses. `slips` (S, 3): of the
        sensor while the press is held. → when it touches, and when it has pressed."""
        self._go(line[0], TRAVEL_M_S)
        begun_s = self._go(line[1], APPROACH_M_S)
        touched_s = self._go(line[2], PRESS_M_S)
        pressed_s = self._go(back[3], PRESS_M_S)
        for slip in slips:
            self._go(back[3] + slip, 0.0, hold_s / len(slips))
        self._touched.append([begun_s, self._go(back[1], PRESS_M_S)])
        self._go(back[0], APPROACH_M_S)
        return touched_s, pressed_s

    def miss(self, begin: Poses, until: Poses) -> None:
        """Go from a pose to another, where nothing is touched, and back."""
        begun_s = self._go(begin, TRAVEL_M_S)
        self._go(until, APPROACH_M_S)
        self._touched.append([begun_s, self._go(begin, TRAVEL_M_S)])

    def push(self, begin: Poses, until: Poses) -> None:
        """Go to a pose and, as slowly as one pushes, straight on to another."""
        self._touched.append([self._go(begin, TRAVEL_M_S), self._go(until, PUSH_M_S)])

    def _go(self, pose: Poses, speed_m_s: float, after_s: float = 0.0) -> float:
        """Go on to a pose (3,) at a speed, or within so long; → when it is there."""
        gap = float(np.linalg.norm(pose[:2] - self.pose[:2]))
        self._t.append(self.now + (gap / speed_m_s if speed_m_s else after_s))
        yaw = self.pose[2] + se2.wrap(np.float64(pose[2] - self.pose[2]))
        self._pose.append(np.array([pose[0], pose[1], yaw]))
        self._tilt.append(self._tilt[-1])
        return self.now
