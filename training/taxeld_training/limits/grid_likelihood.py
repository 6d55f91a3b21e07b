"""How well the cells of the grid filter explain a scan: the filter's own likelihood, over extents.

What a reading says of a pose is the estimator's: floors, full scale, residues of presses before,
and an offset of each remembered scan's own, marginalised as `estimator.likelihood` does. A cell
adds an extent to that, over which its depths range.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.likelihood import HIDDEN, Touches
from taxeld.estimator.scans import Field, fields_of
from taxeld.model import se2
from taxeld.model.noise import Noise, normal_cdf
from taxeld.model.observation import BAND_M, Observation, ObservationModel
from taxeld_training.limits.grid_cells import Cells

BLOCK = 1024  # cells weighed at once: their taxels stay in the cache


class Evidence(NamedTuple):
    """A scan, and how it counts."""

    scan: Observation
    share: float = 1.0  # share of a contact's weight that the scan has
    variance_m2: float = 0.0  # variance [m²] of the scan's offset, in each direction
    touched: bool = True  # False: the scan is silent


class Pairs(NamedTuple):
    """P pairs of a cell and a live taxel that some pose of it may press, in order of cells."""

    cell: NDArray[np.intp]  # (P,) index of the cell
    taxel: NDArray[np.intp]  # (P,) index of the taxel
    depth: Floats  # (P,) over δ_max, at the cell's midpoint; below 0 where it is not reached
    fall: Floats  # (3, P) least change of the depth along each of the cell's edges, ≤ 0
    rise: Floats  # (3, P) greatest change of the depth along each edge, ≥ 0
    across: Floats  # (3, P) change of the depth from end to end of each edge
    slope: Floats  # (2, P) slope [1/m] of the depth along the object frame's x and y


class Offset(NamedTuple):
    """A scan's own offset in n cells, and what that costs."""

    place: Poses  # (n, 3) of the cells' midpoints with it
    mean: Floats  # (n,) gain of a cell's log-likelihood by the integral over the offset
    best: Floats  # (n,) upper bound of that gain for the cell's best pose
    precision: float  # 1 / variance [1/m²]; inf: no offset


class CellLikelihood:
    """How well the poses of a cell explain a scan.

    The depth at a taxel is looked up at the ends of the cell's three middle lines, which gives its
    range within the cell. For the mean over the cell the range widens the noise; for the best pose
    a reading within it is matched exactly. So no cell is judged by a peak that its midpoint misses,
    and where extents are small both are the likelihood itself.
    """

    def __init__(self, model: ObservationModel, noise: Noise) -> None:
        self._model, self._noise = model, noise
        scene = model.scene
        self._flat = scene.slices.ravel()
        self._slice = scene.slice_of(model.layout) * scene.silhouette.size
        pair = np.minimum(scene.slices[:, :, :-1], scene.slices[:, :, 1:])
        lowest = np.full_like(scene.slices, np.inf)  # lowest distance of a grid cell's corners
        lowest[:, :-1, :-1] = np.minimum(pair[:, :-1], pair[:, 1:])
        self._lowest = lowest.ravel()
        self._union = lowest.min(axis=0).ravel()  # lowest distance over all slices

    def add(self, cells: Cells, scans: Sequence[Evidence], first: Poses) -> None:
        """Add the likelihood of scans to the cells; `first` is the sensor's pose (3,) at the touch
        that the cells tile."""
        for each in scans:
            scan = each.scan
            sensor = se2.compose(se2.inverse(first), scan.sensor)
            taxel = se2.apply(sensor, self._model.layout.position_m[:, :2])
            silent = np.where(
                scan.live,
                self._noise.log_density(scan.z, np.zeros(1), scan.floor, scan.residue),
                0.0,
            )
            total = each.share * float(silent.sum())
            cells.log_likelihood += total
            cells.log_likelihood_max += total
            near = self._near(cells, sensor[:2], taxel, _band_m(each))
            for begin in range(0, len(near), BLOCK):
                self._add_block(cells, near[begin : begin + BLOCK], each, sensor, silent)

    def _near(self, cells: Cells, sensor: Floats, taxel: Floats, band_m: float) -> NDArray[np.intp]:
        """Indices of the cells in which some pose may press a taxel, or come within the band of
        it."""
        scene = self._model.scene
        c, s = np.cos(cells.mid[:, 2]), np.sin(cells.mid[:, 2])
        u = (c * sensor[0] + s * sensor[1] + cells.mid[:, 0] - scene.origin[0]) / scene.cell
        v = (c * sensor[1] - s * sensor[0] + cells.mid[:, 1] - scene.origin[1]) / scene.cell
        skin_m = float(np.linalg.norm(taxel - sensor, axis=1).max())
        reach_m = _reach_m(cells.edge, float(np.hypot(*taxel.T).max()))
        apart = self._union.take(self._corner(u, v)[0]) - skin_m - reach_m
        return np.flatnonzero(apart < band_m)

    def _add_block(
        self, cells: Cells, block: NDArray[np.intp], each: Evidence, sensor: Poses, silent: Floats
    ) -> None:
        """Add the likelihood of one scan to some of the cells, for a sensor (3,) whose taxels have
        the log-likelihood `silent` (M,) where nothing presses them."""
        scan, edge = each.scan, cells.edge[block]
        taxel, mid = se2.apply(sensor, self._model.layout.position_m[:, :2]), cells.mid[block]
        reach_m = _reach_m(edge, float(np.hypot(*taxel.T).max()))
        pairs = self._pairs(mid, edge, taxel, scan.live, _band_m(each))
        offset = self._offset(mid, pairs, each, sensor, reach_m)
        if offset.place is not mid:
            pairs = self._pairs(offset.place, edge, taxel, scan.live, _band_m(each))
        elif not each.touched:  # an offset may hide presses that are less deep
            hidden_m = HIDDEN * np.sqrt(each.variance_m2)
            pairs = pairs._replace(depth=pairs.depth - hidden_m / self._model.depth_max_m)
        z, unpressed = scan.z[pairs.taxel], silent[pairs.taxel]
        floor = np.broadcast_to(scan.floor, len(scan.z))[pairs.taxel]
        residue = np.broadcast_to(scan.residue, len(scan.z))[pairs.taxel]

        def of_cells(values: Floats) -> Floats:
            """(B,) sums of the pairs' values (P,) over each of the block's B cells."""
            return np.asarray(np.bincount(pairs.cell, values, len(mid)), dtype=np.float64)

        best = of_cells(self._best(pairs, z, floor, residue) - unpressed) + offset.best
        cells.log_likelihood_max[block] += each.share * best
        mean, known = self._mean(pairs, z, floor, residue)
        gain = of_cells(mean - unpressed) + offset.mean
        cells.log_likelihood[block] += each.share * gain
        cells.information[block] += each.share * _information(pairs, known, offset, of_cells)

    def _offset(
        self, mid: Poses, pairs: Pairs, each: Evidence, sensor: Poses, reach_m: Floats
    ) -> Offset:
        """The scan's own offset, of cells (n, 3) whose poses are at most reach_m (n,) from the
        middle. How far depths range within a cell counts as noise."""
        none, variance = np.zeros(len(mid)), each.variance_m2
        if not variance or not each.touched:
            return Offset(mid, none, none, np.inf)
        seen = se2.compose(mid * [1.0, 1.0, -1.0], sensor)
        fields = fields_of(each.scan.z, each.scan, self._noise)[:, None].repeat(len(mid), axis=1)
        extent = ((pairs.rise - pairs.fall) ** 2).sum(axis=0) / 12.0
        fields[Field.SIGMA2, pairs.cell, pairs.taxel] += extent
        touches = Touches(self._model, self._noise, fields, seen, none + variance, none > 0.0)
        top = touches.top()
        off2 = (top.offset * top.offset).sum(axis=1)
        added = touches.log_p() - top.log_p - 0.5 * off2 / variance
        # The best pose of a cell needs a smaller offset, by its distance from the middle.
        less = off2 - np.maximum(np.sqrt(off2) - reach_m, 0.0) ** 2
        place = mid + np.column_stack([top.offset, none])
        return Offset(place, added, added + 0.5 * less / variance, 1.0 / variance)

    def _best(self, pairs: Pairs, z: Floats, floor: Floats, residue: Floats) -> Floats:
        """Log density (P,) of readings z (P,) at the nearest depth within the cell."""
        depth, fall, rise = pairs.depth, pairs.fall, pairs.rise
        ends = np.clip([depth + fall.sum(axis=0), depth + rise.sum(axis=0)], 0.0, 1.0)
        return self._noise.log_density(z, np.clip(z, *ends), floor, residue)

    def _mean(
        self, pairs: Pairs, z: Floats, floor: Floats, residue: Floats
    ) -> tuple[Floats, Floats]:
        """Log density (P,) of readings z (P,) over the cell, and Fisher's information of each on
        its depth (P,)."""
        change = pairs.rise - pairs.fall
        middle = pairs.depth + 0.5 * (pairs.fall + pairs.rise).sum(axis=0)
        spread = 0.5 * np.sqrt((change**2).sum(axis=0))
        low, high = np.clip([middle - spread, middle + spread], 0.0, 1.0)
        h, within = 0.5 * (low + high), (high - low) ** 2 / 12.0  # mean and variance of the range
        variance = self._noise.variance(h) + residue**2
        off = (np.where(z > 0.0, z, floor) - h) / np.sqrt(variance + within)
        # Where clipping flattens a reading it has no information.
        share = 3.0 * within / np.maximum(spread**2, 1e-30)
        return self._noise.log_of(z, off, variance), share / variance * _told(z, off)

    def _pairs(self, mid: Floats, edge: Floats, taxel: Floats, live: Bools, band_m: float) -> Pairs:
        """The pairs of n cells, midpoints (n, 3) and edges (n, 3, 3), and live taxels (M, 2)."""
        scene = self._model.scene
        reach = _reach_m(edge, float(np.hypot(*taxel.T).max())) + band_m
        # Lengths are in grid cells. A taxel stands at axis + R(−θ) p in the object's frame.
        edge = edge / np.array([scene.cell, scene.cell, 1.0])
        axis = (mid[:, :2] - scene.origin) / scene.cell
        c, s = np.cos(mid[:, 2]), np.sin(mid[:, 2])
        point = np.vstack([taxel.T / scene.cell, np.ones(len(taxel))])
        u = np.column_stack([c, s, axis[:, 0]]) @ point  # (n, M)
        v = np.column_stack([-s, c, axis[:, 1]]) @ point
        lowest = self._lowest.take(self._corner(u, v)[0] + self._slice)
        row, i = np.nonzero((lowest < reach[:, None]) & live)
        u, v, of = u[row, i], v[row, i], self._slice[i]
        depth, slope = self._depth(u, v, of), self._slope(u, v, of)
        half = 0.5 * edge[row].transpose(1, 2, 0)  # (3, 3, P)
        eu = half[:, 0] + half[:, 2] * (v - axis[row, 1])
        ev = half[:, 1] - half[:, 2] * (u - axis[row, 0])
        ends = np.stack([self._depth(u + eu, v + ev, of), self._depth(u - eu, v - ev, of)])
        change = ends - depth
        fall, rise = change.min(axis=0).clip(max=0.0), change.max(axis=0).clip(min=0.0)
        return Pairs(row, i, depth, fall, rise, ends[0] - ends[1], slope)

    def _depth(self, u: Floats, v: Floats, of: NDArray[np.intp]) -> Floats:
        """Depth over δ_max at points of the grid, in the slices that begin at `of`."""
        d00, d01, d10, d11, u, v = self._corners(u, v, of)
        low, high = d00 + (d01 - d00) * u, d10 + (d11 - d10) * u
        return np.asarray((low + (high - low) * v) * (-1.0 / self._model.depth_max_m))

    def _slope(self, u: Floats, v: Floats, of: NDArray[np.intp]) -> Floats:
        """(2, P) by which that depth grows along the grid's x and y [1/m]."""
        d00, d01, d10, d11, u, v = self._corners(u, v, of)
        x = (d01 - d00) * (1.0 - v) + (d11 - d10) * v
        y = (d10 - d00) * (1.0 - u) + (d11 - d01) * u
        return np.stack([x, y]) * (-1.0 / (self._model.scene.cell * self._model.depth_max_m))

    def _corners(self, u: Floats, v: Floats, of: NDArray[np.intp]) -> tuple[Any, ...]:
        """The distances at the four corners of the grid cell that holds each point, and where in it
        the point is."""
        nx = self._model.scene.silhouette.shape[1]
        corner, u, v = self._corner(u, v)
        at = of + corner
        return (*(self._flat.take(at + step) for step in (0, 1, nx, nx + 1)), u, v)

    def _corner(self, u: Floats, v: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Index into a slice of the grid cell that holds each point, and where in it. Outside the
        grid the nearest border value stands."""
        ny, nx = self._model.scene.silhouette.shape
        u, v = np.clip(u, 0.0, nx - 1.001), np.clip(v, 0.0, ny - 1.001)
        iu, iv = u.astype(np.intp), v.astype(np.intp)
        return iv * nx + iu, u - iu, v - iv


def _band_m(each: Evidence) -> float:
    """How far a taxel that matters may be from being pressed."""
    return BAND_M if each.touched and each.variance_m2 else 0.0


def _reach_m(edge: Floats, far_m: float) -> Floats:
    """(n,) how far points at most `far_m` from the touch's axis move between the middle of cells
    with edges (n, 3, 3) and their farthest poses."""
    way = 0.5 * np.hypot(edge[:, :, 0], edge[:, :, 1]) + 0.5 * far_m * np.abs(edge[:, :, 2])
    return np.asarray(way.sum(axis=1))


def _information(
    pairs: Pairs, known: Floats, offset: Offset, of_cells: Callable[[Floats], Floats]
) -> Floats:
    """(n, 3) Fisher information along each edge, times the variance within the cell, of pairs with
    information (P,) on their depths, less the part that the scan's offset explains as well
    (Schur)."""
    change, across = pairs.rise - pairs.fall, pairs.across / np.sqrt(12.0)
    own = np.stack([of_cells(c * c / 12.0 * known) for c in change], axis=1)
    if np.isinf(offset.precision):
        return own
    gx, gy = pairs.slope
    xx, xy, yy = (of_cells(g * known) for g in (gx * gx, gx * gy, gy * gy))
    xx, yy = xx + offset.precision, yy + offset.precision
    bx, by = (np.stack([of_cells(a * g * known) for a in across], axis=1) for g in (gx, gy))
    det = (xx * yy - xy * xy)[:, None]
    shared = (yy[:, None] * bx**2 - 2.0 * xy[:, None] * bx * by + xx[:, None] * by**2) / det
    return np.maximum(own - shared, 0.0)


def _told(z: Floats, off: Floats) -> Floats:
    """The share of a reading's information that is left where it is reported as 0 or as 1: the
    curvature of the logarithm of the normal distribution function."""
    x = np.where(z > 0.0, -off, off)
    ratio = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) / normal_cdf(x)
    return np.where((z > 0.0) & (z < 1.0), 1.0, np.clip(ratio * (ratio + x), 0.0, 1.0))
