"""What follows from the taxels' places in a file: normals where it has none, the cylinder on which
they lie, and the sensor frame.

The estimator models a link as a cylinder about the sensor frame's z axis, but a file gives taxels
in a frame of its own.
"""

import math
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats

PARALLEL = 0.003  # least mean square spread of the normals: less is an arc under about 11°
AXIAL_MAX = 0.5  # share of the normals' spread along the axis; more is a dome
ROUND = 0.1  # length of the mean normal across the axis: shorter only beyond an arc of about 327°
RMS_MAX = 0.25  # share of the radius: with a larger residual the taxels lie on something else
RADIUS_MIN_M = 0.001
RADIUS_MAX_SPANS = 10.0  # patch widths: with a larger radius the arc is too short to tell it
ITERATIONS = 20

NEAR = 9  # taxels that make a tangent plane, of a table whose rows may be few
FLAT = 0.01  # share of a patch's width: a patch that is no deeper is a plane
SAME_M = 1e-6  # distances are compared to a micrometre: the same neighbours on any machine


@dataclass(frozen=True, slots=True)
class CylinderFit:
    """A sensor frame, and the cylinder about its z axis if there is one."""

    frame: Floats  # (4, 4) rigid transform from the file's frame to the sensor frame
    radius_m: float  # inf: the taxels lie on no cylinder
    inwards: Bools  # (M,) whether the normal points to the axis
    why_none: str = ""  # why there is no cylinder, in words


def cylinder(position_m: Floats, normal: Floats) -> CylinderFit:
    """Fit a cylinder to taxels (M, 3) with unit normals (M, 3), both in the file's frame.

    The axis is the direction of which the normals have least; the circle across it has the least
    squared distances. The sensor frame has its origin on the axis, at the middle of the taxels'
    heights; z along the axis, such that its largest component in the file is positive; and x (angle
    0) towards the mean outward normal. A patch that goes all the way round has no such mean: there
    x follows the axis of the file that comes after the one nearest to z (x → y → z → x).

    Where there is no cylinder (parallel normals, a dome, or taxels far from any circle) the radius
    is infinite, the origin the taxels' mean, and z their mean normal.
    """
    spread, directions = np.linalg.eigh(normal.T @ normal / len(normal))
    if spread[1] < PARALLEL:
        return _flat(position_m, normal, "they lie flat")
    if spread[0] > AXIAL_MAX * spread[1]:
        share = f"{spread[0] / spread[1]:.0%} as much along an axis as round it"
        return _flat(position_m, normal, f"they lie as on a dome, bent {share}")
    axis = _positive(directions[:, 0])
    x, y = _across(axis)
    points = position_m @ np.column_stack([x, y])
    centre, radius_m = _circle(points)
    width = float(np.ptp(points, axis=0).max())
    radial = points - centre
    rms = math.sqrt(np.mean((np.hypot(*radial.T) - radius_m) ** 2))
    if not (RADIUS_MIN_M < radius_m < RADIUS_MAX_SPANS * width and rms < RMS_MAX * radius_m):
        off = f"they lie {rms * 1e3:.1f} mm (rms) off a circle of radius {radius_m * 1e3:.4g} mm"
        return _flat(position_m, normal, off)
    inwards = np.einsum("ij,ij->i", normal @ np.column_stack([x, y]), radial) < 0.0
    heights = position_m @ axis
    middle = 0.5 * (heights.min() + heights.max())
    origin = centre[0] * x + centre[1] * y + middle * axis
    mean = np.where(inwards[:, None], -normal, normal).mean(axis=0)
    has_mean = np.linalg.norm(mean - (mean @ axis) * axis) > ROUND
    return CylinderFit(_frame(axis, origin, mean if has_mean else None), radius_m, inwards)


def _flat(position_m: Floats, normal: Floats, why: str) -> CylinderFit:
    """The frame of taxels (M, 3) with unit normals (M, 3) on no cylinder."""
    mean = normal.mean(axis=0)
    length = float(np.linalg.norm(mean))
    axis = mean / length if length > ROUND else np.eye(3)[2]
    frame = _frame(axis, position_m.mean(axis=0))
    return CylinderFit(frame, math.inf, np.zeros(len(normal), dtype=np.bool_), why)


def _positive(direction: Floats) -> Floats:
    """The direction (3,), or its opposite, whose largest component is positive."""
    return np.asarray(direction * np.sign(direction[np.abs(direction).argmax()]))


def _across(axis: Floats, towards: Floats | None = None) -> tuple[Floats, Floats]:
    """Unit x and y of a right-handed frame with z = `axis` (3,), x as near as can be to `towards`
    (3,), else to the axis of the file after the one nearest to z."""
    if towards is None:
        towards = np.roll(np.eye(3)[np.abs(axis).argmax()], 1)
    x = towards - (towards @ axis) * axis
    x = x / np.linalg.norm(x)
    return x, np.cross(axis, x)


def _frame(axis: Floats, origin: Floats, towards: Floats | None = None) -> Floats:
    """The transform (4, 4) to the frame of `_across` with an origin (3,)."""
    frame = np.eye(4)
    frame[:3, :3] = *_across(axis, towards), axis
    frame[:3, 3] = -frame[:3, :3] @ origin
    return frame


def _circle(points: Floats) -> tuple[Floats, float]:
    """Centre (2,) and radius of the circle of least squared distances to points (M, 2).

    Gauss-Newton from the algebraic fit, which alone comes out too small on half a circle.
    """
    middle = points.mean(axis=0)
    points = points - middle
    ones = np.ones(len(points))
    square = np.einsum("ij,ij->i", points, points)
    x, y, rest = np.linalg.lstsq(np.column_stack([2.0 * points, ones]), square)[0]
    centre, radius = np.array([x, y]), math.sqrt(max(rest + x * x + y * y, 0.0))
    for _ in range(ITERATIONS):
        away = points - centre
        distance = np.maximum(np.hypot(*away.T), 1e-12)
        jacobian = np.column_stack([away / distance[:, None], ones])
        step = np.linalg.lstsq(jacobian, distance - radius)[0]
        centre, radius = centre + step[:2], radius + float(step[2])
    return centre + middle, radius


def normals(position_m: Floats, near: int = NEAR) -> Floats:
    """Unit normals (M, 3) of the surface through taxels (M, 3), pointing away from their middle;
    `near`: taxels that make a tangent plane. On a plane all are the same, as `_positive`."""
    widths, axes = _axes(position_m)
    if widths[2] <= FLAT * widths[0]:
        return np.tile(_positive(axes[2]), (len(position_m), 1))
    outwards = position_m - position_m.mean(axis=0)
    found = np.empty_like(position_m)
    for i, place in enumerate(position_m):
        distance = np.round(np.linalg.norm(position_m - place, axis=1) / SAME_M)
        normal = _axes(position_m[np.argsort(distance, kind="stable")[:near]])[1][2]
        found[i] = normal if normal @ outwards[i] >= 0.0 else -normal
    return found


def _axes(points: Floats) -> tuple[Floats, Floats]:
    """Root mean squares (3,) of points (n, 3) along their three principal axes, and these axes as
    rows (3, 3), the widest first."""
    square, axes = np.linalg.eigh(np.cov(points.T, ddof=0))
    return np.sqrt(np.maximum(square[::-1], 0.0)), axes.T[::-1]
