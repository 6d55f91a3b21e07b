"""Straight approaches that a robot can make, and how far its link gets on each."""

import math
from dataclasses import astuple, dataclass, replace

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel

FARTHEST = 10.0  # m and rad
PRESS_M = 0.003  # how far to go on once touched, if the skin can tell as much
FELT_M = 1e-3  # m: a press that is felt, wherever the nearest taxel is
LEAST_STEP_M = 2e-4  # along an edge


@dataclass(frozen=True, slots=True)
class Candidate:
    """An approach of one link's sensor, which goes straight and does not turn; in the world, and in
    the poses that the robot sends."""

    x: float  # where it begins [m]
    y: float
    theta: float  # [rad]
    x1: float  # where it ends if nothing is touched [m]
    y1: float
    link: int = 0

    def __post_init__(self) -> None:
        """Raises SetupError where a number is none, or too large, or the way has no length."""
        if not all(abs(value) <= FARTHEST for value in astuple(self)):
            raise SetupError(f"must be metres and radians, {FARTHEST:g} at most")
        if not self.length_m:
            raise SetupError("must end elsewhere than it begins")

    @property
    def length_m(self) -> float:
        """As far as it goes."""
        return math.hypot(self.x1 - self.x, self.y1 - self.y)

    def after(self, way_m: Floats) -> Poses:
        """(N, 3) the poses after ways (N,)."""
        ahead = np.array([self.x1 - self.x, self.y1 - self.y, 0.0]) / self.length_m
        return np.array([self.x, self.y, self.theta]) + way_m[:, None] * ahead

    def of(self, mount: Poses) -> "Candidate":
        """The same way of a sensor at a pose (3,) in the frame that the robot sends."""
        x, y, theta = se2.compose(self.after(np.zeros(1))[0], mount).tolist()
        x1, y1 = self.x1 + x - self.x, self.y1 + y - self.y
        return replace(self, x=x, y=y, theta=theta, x1=x1, y1=y1)


def depth_m(link: ObservationModel) -> float:
    """How far a press of a link goes on once it touches."""
    return min(PRESS_M, link.depth_max_m)


def way_until_felt(candidate: Candidate, link: ObservationModel, poses: Poses) -> Floats:
    """(K,) the way of a link until it presses an object at poses (K, 3) in the world; inf where it
    passes by."""
    way_m, is_going = np.zeros(len(poses)), np.ones(len(poses), np.bool_)
    while is_going.any():
        seen = se2.compose(se2.inverse(candidate.after(way_m)), poses)
        # nothing is nearer than the gap
        left_m = contacts.clearance(link.scene, link.layout.radius_m, seen) + FELT_M
        is_going = (left_m > 0.0) & (way_m <= candidate.length_m)
        way_m += is_going * np.maximum(left_m, LEAST_STEP_M)
    return np.where(way_m <= candidate.length_m, way_m, np.inf)
