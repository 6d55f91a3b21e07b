"""Contact synthesis: poses at which the object touches the skin, by one projection step.

A pose is drawn uniformly, then the object is moved along the silhouette's distance gradient, t =
−(σ + δ) ∇σ/‖∇σ‖, so that the cylinder presses it δ deep. On a true distance field one step lands
exactly; near the medial axis and grid corners it does not, and such poses are dropped.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.scene import Scene

RESIDUAL_MAX_M = 0.0005


@dataclass(frozen=True, slots=True)
class Contacts:
    """Contact poses of the object in the sensor frame, and how many draws were dropped."""

    pose: Poses  # (n, 3)
    depth_m: Floats  # (n,)
    dropped: int


class Proposal(Protocol):
    """A sampler of p(pose | activations)."""

    @property
    def name(self) -> str: ...

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → object poses (n, 3) in the sensor frame."""
        ...


def clearance(scene: Scene, radius_m: float, poses: Poses) -> Floats:
    """(N,) signed gap [m] between the cylinder and the silhouette, negative when pressed, for an
    object at `poses` (N, 3) in the sensor frame."""
    ax, ay = axis_in_object(poses)
    return scene.clearance(ax, ay)[0] - radius_m


def project(scene: Scene, radius_m: float, poses: Poses, depth_m: Floats) -> tuple[Poses, Floats]:
    """Move `poses` (N, 3) by one step to press `depth_m` (N,) deep; → poses, residual (N,) [m]."""
    ax, ay = axis_in_object(poses)
    distance, gx, gy = scene.clearance(ax, ay)
    step = -(distance - radius_m + depth_m)
    ax, ay = ax + step * gx, ay + step * gy
    residual = np.abs(scene.clearance(ax, ay)[0] - radius_m + depth_m)
    return pose_of_axis(ax, ay, poses[:, 2]), residual


def synthesise(
    scene: Scene, radius_m: float, depth_max_m: float, n: int, rng: np.random.Generator
) -> Contacts:
    """Project `n` uniform poses; the poses that land are returned, the others counted."""
    low, high = scene.extent
    ax, ay = rng.uniform(low[:, None], high[:, None], (2, n))
    theta = rng.uniform(-np.pi, np.pi, n)
    depth = rng.uniform(0.0, depth_max_m, n)
    poses, residual = project(scene, radius_m, pose_of_axis(ax, ay, theta), depth)
    kept = residual <= RESIDUAL_MAX_M
    return Contacts(poses[kept], depth[kept], int(n - kept.sum()))


def axis_in_object(poses: Poses) -> tuple[Floats, Floats]:
    """The cylinder's axis (N,), (N,) in the frame of an object at `poses` (N, 3): −R(θ)ᵀ (x, y)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return -(c * poses[:, 0] + s * poses[:, 1]), s * poses[:, 0] - c * poses[:, 1]


def pose_of_axis(ax: Floats, ay: Floats, theta: Floats) -> Poses:
    """Poses (N, 3) of an object turned by θ (N,) or (), in whose frame the cylinder's axis is at
    (ax, ay), each (N,): the inverse of `axis_in_object`, −R(θ) (ax, ay)."""
    c, s = np.cos(theta), np.sin(theta)
    x, y = -(c * ax - s * ay), -(s * ax + c * ay)
    return np.stack([x, y, np.broadcast_to(theta, x.shape)], axis=-1)
