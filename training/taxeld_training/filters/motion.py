"""The way of a robot about an object, scan by scan.

Between touches the skin is carried around the object. Then it approaches along the contact's
normal, presses deeper and deeper, holds, is released as it was pressed, and backs off. Free motion
is scanned less often than contact, as little happens in it and thousands of trials are run.
"""

from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld_training.filters.conditions import Conditions, Twin

SCAN_S = 0.05  # near the object
FREE_S = 0.2  # on the way around it
APPROACH_M = (0.03, 0.02, 0.01, 0.002)  # clearances before a press
RETREAT_M = (0.002, 0.01, 0.03)  # and after it
PRESSING = (0.25, 0.5, 0.75)  # shares of the press's depth, before it is held
RELEASING = (0.67, 0.33)
FREE = 6  # scans on the way around
CLEAR_M = 0.03  # on that way, at least


class Step(NamedTuple):
    """Where the skin is in one scan."""

    pose: Poses  # (3,) of the object in the sensor frame
    after_s: float  # since the scan before
    gave: float  # share of the way that the object gives in to this touch


def touch(press: Poses, model: ObservationModel, given: Conditions, slips: Poses) -> list[Step]:
    """From the approach to a press (3,) until it is over; `slips` (scans, 3) while it is held."""
    depth_m = -float(contacts.clearance(model.scene, model.layout.radius_m, press[None])[0])
    before = np.concatenate([APPROACH_M, -depth_m * np.array(PRESSING)])
    after = np.concatenate([-depth_m * np.array(RELEASING), RETREAT_M])
    gave = np.concatenate([np.zeros(len(APPROACH_M)), PRESSING])
    return [
        *(Step(pose, SCAN_S, share) for pose, share in zip(
            along(model, press, before), gave.tolist(), strict=True)),
        *(Step(pose, SCAN_S, 1.0) for pose in press + slips[: given.scans]),
        *(Step(pose, SCAN_S, 1.0) for pose in along(model, press, after)),
    ]  # fmt: skip


def along(model: ObservationModel, press: Poses, clearance_m: Floats) -> Poses:
    """(A, 3) the press (3,) moved along the contact's normal until the skin is `clearance_m` (A,)
    from the object; negative: so deep."""
    ax, ay = contacts.axis_in_object(press[None])
    distance, gx, gy = model.scene.clearance(ax, ay)
    away = model.layout.radius_m - distance + clearance_m
    return contacts.pose_of_axis(ax + away * gx, ay + away * gy, press[2])


def around(
    model: ObservationModel, start: Poses, end: Poses, twin: Twin | None = None
) -> list[Step]:
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
    return [Step(pose, FREE_S, 0.0) for pose in contacts.pose_of_axis(x, y, turn)]
