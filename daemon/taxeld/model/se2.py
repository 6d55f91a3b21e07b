"""SE(2): poses as arrays (..., 3) of x [m], y [m], θ [rad]."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Poses

Angles = TypeVar("Angles", np.float64, NDArray[np.float64])

IDENTITY: Poses = np.zeros(3)
TURN = 2.0 * np.pi
JUMP_M = 1.0  # m: a sensor cannot have moved farther between two poses or two scans


def wrap(angle: Angles) -> Angles:
    """Angles of any shape brought into [−π, π), up to rounding."""
    turns: Angles = np.floor((angle + np.pi) / TURN)  # faster than the remainder of a division
    return angle - TURN * turns


def compose(a: Poses, b: Poses) -> Poses:
    """a ∘ b for poses (..., 3) that broadcast: the pose b, given in the frame a, in the outer frame
    of a."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def inverse(a: Poses) -> Poses:
    """The pose (..., 3) of the outer frame as seen from a (..., 3)."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = -c * a[..., 0] - s * a[..., 1]
    y = s * a[..., 0] - c * a[..., 1]
    return np.stack([x, y, wrap(-a[..., 2])], axis=-1)


def apply(pose: Poses, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 2) given in the frame `pose` (3,), in the outer frame of `pose`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(points @ np.array([[c, s], [-s, c]]) + pose[:2])


def rotation_about(centre: NDArray[np.float64], angle: float) -> Poses:
    """The pose (3,) that turns by `angle` about the point `centre` (2,)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = centre
    return np.array([x - c * x + s * y, y - s * x - c * y, wrap(np.float64(angle))])
