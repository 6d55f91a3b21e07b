"""Normals for a file that has none: the cylinder's axis follows from them, and a patch's own
curvature tells them."""

import numpy as np

from taxeld.arrays import Floats

NEAR = 9  # taxels that make a tangent plane, of a table whose rows may be few
FLAT = 0.01  # share of a patch's width: a patch that is no deeper is a plane
SAME_M = 1e-6  # distances are compared to a micrometre: the same neighbours on any machine


def of_positions(position_m: Floats, near: int = NEAR) -> Floats:
    """Unit normals (M, 3) of the surface through taxels (M, 3), pointing away from their middle;
    `near`: taxels that make a tangent plane.

    On a plane all are the same, and their largest component is positive.
    """
    widths, axes = _axes(position_m)
    if widths[2] <= FLAT * widths[0]:
        normal = axes[2]
        return np.tile(normal * np.sign(normal[np.abs(normal).argmax()]), (len(position_m), 1))
    outwards = position_m - position_m.mean(axis=0)
    normals = np.empty_like(position_m)
    for i, place in enumerate(position_m):
        distance = np.round(np.linalg.norm(position_m - place, axis=1) / SAME_M)
        normal = _axes(position_m[np.argsort(distance, kind="stable")[:near]])[1][2]
        normals[i] = normal if normal @ outwards[i] >= 0.0 else -normal
    return normals


def _axes(points: Floats) -> tuple[Floats, Floats]:
    """Root mean squares (3,) of points (n, 3) along their three principal axes, and these axes as
    rows (3, 3), the widest first."""
    square, axes = np.linalg.eigh(np.cov(points.T, ddof=0))
    return np.sqrt(np.maximum(square[::-1], 0.0)), axes.T[::-1]
