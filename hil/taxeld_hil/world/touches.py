"""Touches at a steady pace, all around the object: each a ramp in, a hold and a ramp out, a second
of contact in all."""

from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model.observation import ObservationModel
from taxeld_hil.world import robot
from taxeld_hil.world.robot import RobotPath

APART_S = (2.0, 3.0)  # range of times between the beginnings of two touches
PRESS_MM = (2.0, 4.5)  # of foam whose full scale is 5 mm deep; of other foam in proportion
RAMP_S, HOLD_S = 0.3, 0.7
SLOW_FROM_M = 0.004  # clearance at which a ramp begins and ends
SIDEWAYS = 0.7  # most that an approach passes the centre by, in sizes of the object
REST_S = 2.0


class Touch(NamedTuple):
    """Times on the path."""

    begin_s: float  # begin of the ramp in: nothing is touched yet
    held_s: tuple[float, float]
    end_s: float  # end of the ramp out


class TouchPlan(NamedTuple):
    path: RobotPath
    touches: tuple[Touch, ...]


class Track:
    """Waypoints as they are added."""

    def __init__(self, start: Poses) -> None:
        self.now = 0.0
        self.times, self.poses = [0.0], [start]

    def go(self, way: Floats, seconds: float) -> None:
        """Through poses (W, 3) in so many seconds, at an even speed."""
        steps = np.linalg.norm(np.diff(np.vstack([self.poses[-1], way])[:, :2], axis=0), axis=1)
        done = np.cumsum(steps) / max(float(steps.sum()), 1e-9)
        self.times += (self.now + seconds * done).tolist()
        self.poses += list(way)
        self.now += seconds
        self.times[-1] = self.now

    def touch(self, at: Poses) -> Touch:
        """Add a ramp in to a pose (3,), a hold, and a ramp out."""
        begin, away = self.now, self.poses[-1]
        self.go(at[None], RAMP_S)
        held = self.now, self.now + HOLD_S
        self.go(at[None], HOLD_S)
        self.go(away[None], RAMP_S)
        return Touch(begin, held, self.now)


def plan(model: ObservationModel, truth: Poses, seed: int, presses: int) -> TouchPlan:
    """So many touches around the object at `truth` (3,)."""
    rng, scene = np.random.default_rng(seed), model.scene
    circle = robot.Circle(model, truth)
    angle = rng.uniform(-np.pi, np.pi)
    yaw = robot.first_yaw(model.layout, angle)
    track = Track(np.array([*circle.at(angle), yaw]))
    touches: list[Touch] = []
    out = track.poses[0][None]
    step, share = 2.0 * np.pi / presses, robot.depth_share(model)

    def draw() -> tuple[float, float]:
        depth_m = 1e-3 * share * rng.uniform(*PRESS_MM)
        return depth_m, rng.uniform(-SIDEWAYS, SIDEWAYS) * scene.size

    for _ in range(presses):
        before, angle = angle, angle + step * rng.uniform(0.7, 1.3)
        yaw_to = robot.next_yaw(model.layout, angle, yaw, rng)
        line = circle.press(angle, yaw_to, draw, SLOW_FROM_M)
        arc = robot.arc_of(before, angle)
        way = np.column_stack([circle.at(arc), np.linspace(yaw, yaw_to, len(arc))])
        gone = track.now - touches[-1].begin_s if touches else 0.0
        track.go(np.vstack([out, way, line[:2]]), max(rng.uniform(*APART_S) - gone, 0.5))
        out = line[:1]  # the way out is the way in
        touches.append(track.touch(line[2]))
        yaw = yaw_to
    track.go(np.vstack([out, [*circle.at(angle), yaw]]), 0.5)
    track.go(track.poses[-1][None], REST_S)
    touched = np.array([(touch.begin_s, touch.end_s) for touch in touches])
    path = RobotPath(np.array(track.times), np.array(track.poses), touched)
    return TouchPlan(path, tuple(touches))
