"""Coordinates in which a model learns poses: the pose's own, or those of the contact it makes.

All samples of a touch lie on the contact manifold, a thin curved sheet in (x, y, θ). In contact
coordinates the sheet is flat. s is where along the object's contact curve the skin's axis is; a
touch leaves it ambiguous. φ is the direction of the contact and δ its depth; both are sharp.
"""

import contourpy
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor, nn

from taxeld.arrays import Floats, Poses
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import Scene

CURVE_POINTS = 1024  # points of the contact curve in the graph: 0.9 mm apart on a power drill
CURVE_FINE = 16  # factor of the points among which `encode` looks up s


class PoseFrame(nn.Module):
    """(x, y, θ) and the features (x, y, cos θ, sin θ): the paper's."""

    def encode(self, poses: Poses) -> Tensor:
        """Poses (n, 3) → coordinates (n, 3)."""
        return torch.from_numpy(poses).float()

    def turned(self, coordinates: Tensor, angle: Tensor) -> Tensor:
        """Coordinates (n, 3) once the touch is turned about the sensor's axis by −angle (n,)."""
        x, y, theta = coordinates.unbind(-1)
        c, s = torch.cos(angle), torch.sin(angle)
        return torch.stack([c * x + s * y, c * y - s * x, theta - angle], dim=-1)

    def features(self, coordinates: Tensor) -> Tensor:
        """Coordinates (n, 3) → (n, 4) without a seam, for a diffusion to work in."""
        x, y, theta = coordinates.unbind(-1)
        return torch.stack([x, y, torch.cos(theta), torch.sin(theta)], dim=-1)

    def decode(self, features: Tensor) -> Tensor:
        """Features (n, 4) → poses (n, 4): x, y, cos θ, sin θ."""
        return features


class ContactFrame(nn.Module):
    """(s, φ, δ): where along the contact curve, from which direction, how deep.

    The contact curve holds the positions of the skin's axis, in the object's frame, at which the
    skin just touches: the level set of the silhouette's distance at the skin's radius R. s in 0..1
    is its arc length over all its loops, φ the direction from the axis to the contact in the sensor
    frame [rad], δ the depth [m]. At depth δ the axis is δ further in along the curve's normal.
    """

    point: Tensor  # (P, 2) [m] points of the curve, object frame
    normal: Tensor  # (P, 2) unit normals, outwards
    after: Tensor  # (P,) index of the next point of the same loop

    def __init__(self, model: ObservationModel) -> None:
        super().__init__()
        self._model = model
        self.depth_max_m = model.depth_max_m
        self._tree = cKDTree(_curve(model, CURVE_POINTS * CURVE_FINE)[0])
        point, after = _curve(model, CURVE_POINTS)
        _, gx, gy = model.scene.clearance(*point.T)
        self.register_buffer("point", torch.from_numpy(point).float())
        self.register_buffer("normal", torch.from_numpy(np.column_stack([gx, gy])).float())
        self.register_buffer("after", torch.from_numpy(after))

    def encode(self, poses: Poses) -> Tensor:
        """Poses (n, 3) → coordinates (n, 3)."""
        scene = self._model.scene
        ax, ay = contacts.axis_in_object(poses)
        distance, gx, gy = scene.clearance(ax, ay)
        depth = self._model.layout.radius_m - distance
        nearest = self._tree.query(np.column_stack([ax + depth * gx, ay + depth * gy]))[1]
        s = torch.from_numpy(nearest / self._tree.n).float()
        nx, ny = self._at(s)[1].double().numpy().T
        phi = poses[:, 2] + np.arctan2(-ny, -nx)
        return torch.stack(
            [s, _wrap(torch.from_numpy(phi).float()), torch.from_numpy(depth).float()], dim=-1
        )

    def turned(self, coordinates: Tensor, angle: Tensor) -> Tensor:
        """Coordinates (n, 3) once the touch is turned about the sensor's axis by −angle (n,)."""
        s, phi, depth = coordinates.unbind(-1)
        return torch.stack([s, _wrap(phi - angle), depth], dim=-1)

    def features(self, coordinates: Tensor) -> Tensor:
        """Coordinates (n, 3) → (n, 4): cos and sin of s, φ, δ."""
        s, phi, depth = coordinates.unbind(-1)
        around = 2.0 * torch.pi * s
        return torch.stack([torch.cos(around), torch.sin(around), phi, depth], dim=-1)

    def decode(self, features: Tensor) -> Tensor:
        """Features (n, 4) → poses (n, 4): x, y, cos θ, sin θ."""
        c, s, phi, depth = features.unbind(-1)
        return self.pose(torch.atan2(s, c) / (2.0 * torch.pi), phi, depth)

    def pose(self, s: Tensor, phi: Tensor, depth: Tensor) -> Tensor:
        """Coordinates, each (n,), s of any period → poses (n, 4)."""
        point, normal = self._at(s)
        axis = point - depth.clamp(0.0, self.depth_max_m)[..., None] * normal
        nx, ny = normal.unbind(-1)
        c, si = torch.cos(phi), torch.sin(phi)
        cos, sin = (
            -(c * nx + si * ny),
            c * ny - si * nx,
        )  # cosine and sine of θ = φ − the direction of −n
        ax, ay = axis.unbind(-1)
        return torch.stack([sin * ay - cos * ax, -sin * ax - cos * ay, cos, sin], dim=-1)

    def _at(self, s: Tensor) -> tuple[Tensor, Tensor]:
        """Point and unit normal (n, 2) of the curve at s (n,)."""
        at = (s - torch.floor(s)) * len(self.point)
        i = at.long().clamp(max=len(self.point) - 1)
        share = (at - i)[..., None]
        j = self.after[i]
        normal = torch.lerp(self.normal[i], self.normal[j], share)
        return (
            torch.lerp(self.point[i], self.point[j], share),
            normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-6),
        )


def rotated(poses: Tensor, angle: Tensor) -> Tensor:
    """Poses (n, 4) turned about the sensor's axis by `angle` (n or 1,)."""
    x, y, cos, sin = poses.unbind(-1)
    c, s = torch.cos(angle), torch.sin(angle)
    return torch.stack([c * x - s * y, s * x + c * y, c * cos - s * sin, s * cos + c * sin], dim=-1)


def level_sets(scene: Scene, distance_m: float) -> list[Floats]:
    """Loops (n, 2), first point repeated, at a distance from the silhouette."""
    ny, nx = scene.silhouette.shape
    x, y = (scene.origin[i] + scene.cell * np.arange(n) for i, n in enumerate((nx, ny)))
    found = contourpy.contour_generator(x, y, scene.silhouette).lines(distance_m)
    return [np.asarray(loop, dtype=np.float64) for loop in found]


def _curve(model: ObservationModel, points: int) -> tuple[Floats, NDArray[np.int64]]:
    """Points (P, 2) evenly along all loops of the contact curve, and the one after each."""
    loops = level_sets(model.scene, model.layout.radius_m)
    lengths = [np.linalg.norm(np.diff(loop, axis=0), axis=1).cumsum() for loop in loops]
    ends = np.cumsum([length[-1] for length in lengths])
    at = np.arange(points) / points * ends[-1]
    found, after = [], np.arange(1, points + 1)
    begin = 0
    for loop, length, end in zip(loops, lengths, ends, strict=True):
        mine = at[begin:][at[begin:] < end] - (end - length[-1])
        if not len(mine):  # a loop shorter than the spacing of the points
            continue
        knots = np.concatenate([[0.0], length])
        found.append(np.column_stack([np.interp(mine, knots, loop[:, i]) for i in (0, 1)]))
        after[begin + len(mine) - 1] = begin
        begin += len(mine)
    return np.concatenate(found), after


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi
