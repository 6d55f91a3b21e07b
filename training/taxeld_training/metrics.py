"""How good sampled poses are: against the truth, the contact, the reading and the posterior.

Plain ADD against the true pose cannot rank samplers, since one touch is ambiguous and the exact
posterior itself is far from the truth; the distance to the exact posterior can. Both are kept.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from taxeld import contacts, se2
from taxeld.observation import ObservationModel
from taxeld.scene import Scene
from taxeld.se2 import Poses

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SampleErrors:
    """Of n samples of one reading; lengths in mm."""

    add_mm: Floats  # (n,) average distance of surface points (the paper's)
    add_sym_mm: Floats  # (n,) the least over the object's geometric rotation group
    add_s_mm: Floats  # (n,) to the nearest point of the true surface
    contact_residual_mm: Floats  # (n,) |σ + δ|: how far from the depth that was pressed
    observation_residual: Floats  # (n,) max over taxels |h(q) − z|


def sample_errors(model: ObservationModel, z: Floats, truth: Poses, poses: Poses) -> SampleErrors:
    """Errors of poses (n, 3) sampled for a reading z (M,) of the pose `truth` (3,), all in the
    sensor frame."""
    radius_m = model.layout.radius_m
    pressed = contacts.clearance(model.scene, radius_m, truth[None])
    residual = np.abs(contacts.clearance(model.scene, radius_m, poses) - pressed)
    return SampleErrors(
        add_mm=1e3 * add(model.scene, poses, truth),
        add_sym_mm=1e3 * add_symmetric(model.scene, poses, truth),
        add_s_mm=1e3 * add_s(model.scene, poses, truth),
        contact_residual_mm=1e3 * residual,
        observation_residual=np.abs(model.activation(poses) - z).max(axis=1),
    )


def add(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """ADD (n,) [m]: mean distance of surface points at poses (n, 3) from those at `truth` (3,)."""
    gap = place(poses, scene.surface[:, :2]) - se2.apply(truth, scene.surface[:, :2])
    return np.asarray(np.linalg.norm(gap, axis=2).mean(axis=1))


def add_symmetric(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """The least ADD (n,) [m] to any pose that touch cannot tell from `truth`."""
    equivalent = se2.compose(truth, scene.equivalents)
    return np.asarray(np.min([add(scene, poses, pose) for pose in equivalent], axis=0))


def add_s(scene: Scene, poses: Poses, truth: Poses) -> Floats:
    """ADD-S (n,) [m]: mean distance of surface points to the nearest of those at `truth`."""
    z = scene.surface[:, 2]
    tree = cKDTree(np.column_stack([se2.apply(truth, scene.surface[:, :2]), z]))
    placed = place(poses, scene.surface[:, :2])
    points = np.concatenate([placed, np.broadcast_to(z[:, None], (*placed.shape[:2], 1))], axis=2)
    return np.asarray(tree.query(points)[0].mean(axis=1))


def place(poses: Poses, points: Floats) -> Floats:
    """Points (Q, 2) of the object at poses (n, 3) → (n, Q, 2)."""
    c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
    x, y = points.T
    return np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y], axis=2)
