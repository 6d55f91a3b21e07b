"""Normals for a file that tells none: iCub's positions come without, or with one for all taxels.

Normals are needed for the cylinder's axis, which a patch's own curvature tells as well.
"""

import numpy as np

from taxeld.arrays import Floats

NEAR = 20  # taxels that make a tangent plane: two triangles, over which the link is nearly flat
NEAR_BARE = 9  # the same in a table without normals, whose rows may be few
FLAT = 0.01  # share of a patch's width: a patch that is no deeper is a plane
ONE_WAY = 1e-6  # normals that differ by no more count as one
UPRIGHT = 0.5  # least cosine between a plane's normal and the file's, to take the file's for it
SAME_M = 1e-6  # distances are compared to a micrometre: the same neighbours on any machine


def tells_none(position_m: Floats, normal: Floats) -> bool:
    """Whether a patch (M, 3) has no normals (M, 3), or one for all that is not the normal of a
    plane through it."""
    if not np.any(normal):
        return True
    if np.ptp(normal, axis=0).max() > ONE_WAY:
        return False
    widths, axes = _axes(position_m)
    return not (
        _is_plane(widths) and abs(normal[0] @ axes[2]) > UPRIGHT * np.linalg.norm(normal[0])
    )


def of_positions(position_m: Floats, near: int = NEAR) -> Floats:
    """Unit normals (M, 3) of the surface through taxels (M, 3), pointing away from their middle;
    `near`: taxels that make a tangent plane.

    On a plane all are the same, and their largest component is positive.
    """
    widths, axes = _axes(position_m)
    if _is_plane(widths):
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


def _is_plane(widths: Floats) -> bool:
    """Whether points with these widths (3,) along their principal axes lie on a plane."""
    return bool(widths[2] <= FLAT * widths[0])
