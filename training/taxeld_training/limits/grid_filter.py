"""The limit of the filters: a Bayes filter for an object that stays, on a sparse grid, no chance.

The first touch confines the pose to the first cells (`grid_cells`). Every scan then weighs them,
drops those that no longer matter, and halves those that may weigh something and whose extent
changes readings by more than their noise. The cells are the leaves of a tree of boxes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Bools, Floats, Poses
from taxeld.estimator.estimate import MODE_CANDIDATES, MODE_RADIUS_M, MODES_MAX
from taxeld.model import contacts, se2
from taxeld.model.observation import Noise, Observation, ObservationModel, normal_cdf
from taxeld.model.symmetry import PoseMetric
from taxeld_training.limits.grid_cells import Cells, tile

DROP_NATS = 20.0  # a cell whose best pose is this far below the best of all no longer matters
COARSE = 0.5  # information in a cell from which it is halved: an extent of 2.4 sd
SHARE = 1e-4  # of the belief: a cell that cannot weigh more may stay coarse
CELLS = 60_000  # so many are halved no further
TOUCH_SIGMAS = 5.0  # a reading of so many σ is a touch: one of 3·10⁶ silent taxels reads as much
PICKED = 32 * MODE_CANDIDATES  # poses that modes are sought among

BLOCK = 1024  # cells weighed at once: their taxels stay in the cache


class Pairs(NamedTuple):
    """P pairs of a cell and a live taxel that some pose of the cell may press."""

    cell: NDArray[np.intp]  # (P,)
    taxel: NDArray[np.intp]  # (P,)
    depth: Floats  # (P,) over δ_max, at the cell's midpoint
    fall: Floats  # (3, P) how much less of it there is along each of the cell's edges, ≤ 0
    rise: Floats  # (3, P) how much more, ≥ 0


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
        lowest = np.full_like(scene.slices, np.inf)  # of a grid cell's corners
        lowest[:, :-1, :-1] = np.minimum(pair[:, :-1], pair[:, 1:])
        self._lowest = lowest.ravel()

    def add(self, cells: Cells, scans: Sequence[Observation], first: Poses) -> None:
        """Add the likelihood of scans to the cells; `first` is the sensor's pose (3,) at the first
        touch."""
        for scan in scans:
            sensor = se2.compose(se2.inverse(first), scan.sensor)
            taxel = se2.apply(sensor, self._model.layout.position_m[:, :2])
            silent = np.where(
                scan.live, self._noise.log_density(scan.z, np.zeros(1), scan.floor), 0.0
            )
            for begin in range(0, len(cells), BLOCK):
                self._add_block(cells, slice(begin, begin + BLOCK), scan, taxel, silent)

    def _add_block(
        self, cells: Cells, block: slice, scan: Observation, taxel: Floats, silent: Floats
    ) -> None:
        """The same of a scan and a slice of the cells, for taxels at (M, 2) whose log-likelihood is
        `silent` (M,) where nothing presses them."""
        mid, edge = cells.mid[block], cells.edge[block]
        pairs = self._pairs(mid, edge, taxel, scan.live)
        z, unpressed = scan.z[pairs.taxel], silent[pairs.taxel]
        floor = np.broadcast_to(scan.floor, len(scan.z))[pairs.taxel]

        def of_cells(values: Floats) -> Floats:
            return np.asarray(np.bincount(pairs.cell, values, len(mid)), dtype=np.float64)

        best = self._best(pairs, z, floor)
        cells.log_likelihood_max[block] += silent.sum() + of_cells(best - unpressed)
        mean, information = self._mean(pairs, z, floor)
        cells.log_likelihood[block] += silent.sum() + of_cells(mean - unpressed)
        for j in range(3):
            cells.information[block, j] += of_cells(information[j])

    def _best(self, pairs: Pairs, z: Floats, floor: Floats) -> Floats:
        """Log density (P,) of readings z (P,) at the nearest depth within the cell."""
        depth, fall, rise = pairs.depth, pairs.fall, pairs.rise
        ends = np.clip([depth + fall.sum(axis=0), depth + rise.sum(axis=0)], 0.0, 1.0)
        return self._noise.log_density(z, np.clip(z, *ends), floor)

    def _mean(self, pairs: Pairs, z: Floats, floor: Floats) -> tuple[Floats, Floats]:
        """Log density (P,) of readings z (P,) over the cell, and its information (3, P) along each
        edge."""
        change = pairs.rise - pairs.fall
        middle = pairs.depth + 0.5 * (pairs.fall + pairs.rise).sum(axis=0)
        spread = 0.5 * np.sqrt((change**2).sum(axis=0))
        low, high = np.clip([middle - spread, middle + spread], 0.0, 1.0)
        h, within = 0.5 * (low + high), (high - low) ** 2 / 12.0  # mean and variance of the range
        variance = self._noise.variance(h)
        off = (np.where(z > 0.0, z, floor) - h) / np.sqrt(variance + within)
        # no information where clipping flattens a reading
        per_change = 0.25 * within / np.maximum(spread**2, 1e-30) / variance
        return self._noise.log_of(z, off, variance), change**2 * per_change * _told(z, off)

    def _pairs(self, mid: Floats, edge: Floats, taxel: Floats, live: Bools) -> Pairs:
        """The pairs of n cells, midpoints (n, 3) and edges (n, 3, 3), and live taxels (M, 2)."""
        scene = self._model.scene
        # in grid cells: a taxel stands at axis + R(−θ) p in the object's frame
        edge = edge / np.array([scene.cell, scene.cell, 1.0])
        axis = (mid[:, :2] - scene.origin) / scene.cell
        c, s = np.cos(mid[:, 2]), np.sin(mid[:, 2])
        point = np.vstack([taxel.T / scene.cell, np.ones(len(taxel))])
        u = np.column_stack([c, s, axis[:, 0]]) @ point  # (n, M)
        v = np.column_stack([-s, c, axis[:, 1]]) @ point
        far = np.linalg.norm(point[:2], axis=0).max()
        reach = 0.5 * np.hypot(edge[:, :, 0], edge[:, :, 1]) + 0.5 * far * np.abs(edge[:, :, 2])
        lowest = self._lowest.take(self._corner(u, v)[0] + self._slice)
        row, i = np.nonzero((lowest < scene.cell * reach.sum(axis=1)[:, None]) & live)
        u, v, of = u[row, i], v[row, i], self._slice[i]
        depth = self._depth(u, v, of)
        half = 0.5 * edge[row].transpose(1, 2, 0)  # (3, 3, P)
        eu = half[:, 0] + half[:, 2] * (v - axis[row, 1])
        ev = half[:, 1] - half[:, 2] * (u - axis[row, 0])
        ends = np.stack([self._depth(u + eu, v + ev, of), self._depth(u - eu, v - ev, of)])
        change = ends - depth
        fall, rise = change.min(axis=0).clip(max=0.0), change.max(axis=0).clip(min=0.0)
        return Pairs(row, i, depth, fall, rise)

    def _depth(self, u: Floats, v: Floats, of: NDArray[np.intp]) -> Floats:
        """Depth over δ_max at points of the grid, in the slices that begin at `of`."""
        nx = self._model.scene.silhouette.shape[1]
        corner, u, v = self._corner(u, v)
        corner += of
        d00, d01 = self._flat.take(corner), self._flat.take(corner + 1)
        d10, d11 = self._flat.take(corner + nx), self._flat.take(corner + nx + 1)
        low, high = d00 + (d01 - d00) * u, d10 + (d11 - d10) * u
        return np.asarray((low + (high - low) * v) * (-1.0 / self._model.depth_max_m))

    def _corner(self, u: Floats, v: Floats) -> tuple[NDArray[np.intp], Floats, Floats]:
        """Index into a slice of the grid cell that holds each point, and where in it. Outside the
        grid the nearest border value stands."""
        ny, nx = self._model.scene.silhouette.shape
        u, v = np.clip(u, 0.0, nx - 1.001), np.clip(v, 0.0, ny - 1.001)
        iu, iv = u.astype(np.intp), v.astype(np.intp)
        return iv * nx + iu, u - iu, v - iv


class GridFilter:
    """The belief over the poses of an object that stays where it is, given all scans so far.

    The prior is uniform over the poses that the first touch may have; the noise's share of outliers
    must not be zero. The same scans give the same belief.
    """

    def __init__(
        self, model: ObservationModel, noise: Noise, *, cells: int = CELLS, coarse: float = COARSE
    ) -> None:
        self.metric = PoseMetric(model.scene)
        self._model = model
        self._noise = noise
        self._likelihood = CellLikelihood(model, noise)
        self._most = cells
        self._coarse = coarse
        self._scans: list[Observation] = []
        self._first = se2.IDENTITY  # the sensor's pose at the first touch
        self._cells = Cells.unweighed(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self._cells)

    @property
    def pose(self) -> Poses:
        """(n, 3) midpoints of the cells in the world; none before the first touch."""
        return se2.compose(self._first, contacts.pose_of_axis(*self._cells.mid.T))

    @property
    def weight(self) -> Floats:
        """(n,) of the cells; sums to 1."""
        return self._cells.weight if len(self) else np.empty(0)

    def update(self, scan: Observation, *, touched: bool | None = None) -> None:
        """Learn from a scan.

        `touched` says whether the object touches the skin, where that is known; None leaves it to
        the readings. It matters until the first touch alone: scans before it are kept and weighed
        at that touch.
        """
        self._scans.append(scan)
        if len(self):
            self._likelihood.add(self._cells, [scan], self._first)
            self._refine()
            return
        if touched is None:
            touched = bool(
                scan.z.max(initial=0.0, where=scan.live) > TOUCH_SIGMAS * self._noise.sigma
            )
        if touched:
            self._first = scan.sensor
            self._cells = tile(self._model)
            self._likelihood.add(self._cells, self._scans, self._first)
            self._refine()

    def estimate(self) -> tuple[Poses, Poses]:
        """The mean of the heaviest mode (3,) and of the whole belief (3,), as the daemon's are.

        Raises:
            ValueError: nothing was touched yet.
        """
        if not len(self):
            raise ValueError("no estimate before the first touch")
        # Modes are sought around the heaviest of given poses. Those of the heaviest cells would all
        # be in one peak, so poses of equal weight are picked evenly through the belief, in an order
        # that spreads the candidates, the first of them, as evenly.
        pose, weight = self.pose, self.weight
        cumulative = np.cumsum(weight)
        cumulative[-1] = 1.0  # rounding must not leave the last without a cell
        at = (np.arange(PICKED).reshape(MODE_CANDIDATES, -1).T.ravel() + 0.5) / PICKED
        picked = pose[np.searchsorted(cumulative, at)]
        equal = np.full(PICKED, 1.0 / PICKED)
        modes = self.metric.modes(
            picked, equal, MODE_RADIUS_M * self.metric.scale, MODES_MAX, MODE_CANDIDATES
        )
        best = modes[0].pose
        return best, self.metric.mean(pose, weight, best)[0]

    def _refine(self) -> None:
        """Drop the cells that do not matter and halve those that are coarse and weigh much, until
        none is left to halve."""
        cells = self._cells
        while True:
            best = cells.log_likelihood_max
            cells = cells[best >= best.max() - DROP_NATS]
            weight = cells.log_weight_max
            coarse = (cells.information.max(axis=1) > self._coarse) & (weight > np.log(SHARE))
            room = self._most - len(cells)
            if not coarse.any() or room <= 0:
                break
            if coarse.sum() > room:
                coarse &= weight >= np.partition(weight[coarse], -room)[-room]
            parts = cells[coarse].halved()
            self._likelihood.add(parts, self._scans, self._first)
            cells = cells[~coarse].joined(parts)
        self._cells = cells


def _told(z: Floats, off: Floats) -> Floats:
    """The share of a reading's information that is left where it is reported as 0 or as 1: the
    curvature of the logarithm of the normal distribution function."""
    x = np.where(z > 0.0, -off, off)
    ratio = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi) / normal_cdf(x)
    return np.where((z > 0.0) & (z < 1.0), 1.0, np.clip(ratio * (ratio + x), 0.0, 1.0))
