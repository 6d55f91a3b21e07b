"""The presses of a calibration: round the object, with every side of the skin, held still.

What a guided user is asked for, as a robot would do it: press after press on the next side of the
object, the skin turned so that each press is felt by another stretch of it.
"""

import numpy as np

from taxeld.arrays import Poses
from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_hil.world import robot
from taxeld_hil.world.robot import RobotPath
from taxeld_hil.world.touches import Touch, TouchPlan, Track

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # turns from one stretch of skin to the next: even at any count
PRESS_MM = (3.4, 4.8)  # firm, but not beyond full depth
SIDEWAYS = 0.35  # most that an approach passes the centre by, in sizes of the object
WAY_S = 1.2  # time between two presses
SLOW_FROM_M = 0.004
IDLE_S = 20.0


def plan(
    model: ObservationModel, truth: Poses, seed: int, presses: int = 20, idle_s: float = IDLE_S
) -> TouchPlan:
    """`idle_s` untouched, then so many presses of the object at `truth` (3,)."""
    rng, scene = np.random.default_rng(seed), model.scene
    circle = robot.Circle(model, truth)
    angle, skin = rng.uniform(-np.pi, np.pi, 2)
    yaw = angle + np.pi - skin
    track = Track(np.array([*circle.at(angle), yaw]))
    track.go(track.poses[0][None], idle_s)
    touches: list[Touch] = []
    for k in range(presses):
        before = angle
        angle += 2.0 * np.pi / presses * rng.uniform(0.7, 1.3)
        skin += 2.0 * np.pi * GOLDEN
        yaw_to = yaw + se2.wrap(np.float64(angle + np.pi - skin - yaw))

        def draw(golden: float = k * GOLDEN) -> tuple[float, float]:
            share = (golden + 0.3 * rng.random()) % 1.0
            depth_m = 1e-3 * (PRESS_MM[0] + (PRESS_MM[1] - PRESS_MM[0]) * share)
            return depth_m, rng.uniform(-SIDEWAYS, SIDEWAYS) * scene.size

        line = circle.press(angle, yaw_to, draw, SLOW_FROM_M)
        arc = robot.arc_of(before, angle)
        way = np.column_stack([circle.at(arc), np.linspace(yaw, yaw_to, len(arc))])
        track.go(np.vstack([way, line[:2]]), WAY_S)
        touches.append(track.touch(line[2]))
        track.go(np.vstack([line[:1], way[-1:]]), 0.3)
        yaw = yaw_to
    track.go(track.poses[-1][None], 1.0)
    return TouchPlan(RobotPath(np.array(track.times), np.array(track.poses)), tuple(touches))
