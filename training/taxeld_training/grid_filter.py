"""The limit of the filters: a Bayes filter for an object that stays, on a sparse grid, no chance.

The first touch confines the pose to the band where the skin presses the object 0..δ_max deep. The
band is tiled in contact coordinates: cells along the level sets of the silhouette's distance (s),
across them (δ), and in the direction from which the object is touched (φ). Such a cell is a box of
axis positions and turns, so a prior that is uniform in the pose weighs it by its volume. Every scan
then drops the cells that no longer matter, and halves those that may weigh something and whose
extent changes readings by more than their noise: a tree of boxes.
"""

from dataclasses import dataclass, fields
from typing import Self

import contourpy
import numpy as np
from numpy.typing import NDArray

from taxeld import se2
from taxeld.estimate import MODE_CANDIDATES, MODE_RADIUS_M, MODES_MAX
from taxeld.observation import Noise, ObservationModel
from taxeld.scene import Scene
from taxeld.se2 import Poses
from taxeld.symmetry import PoseMetric

FIRST_M, FIRST_DEEP_M, FIRST_RAD = 0.005, 0.00125, np.deg2rad(5.0)  # extents of the first cells
DROP_NATS = 20.0  # a cell that at its best is this far below the best no longer matters
COARSE = 0.5  # information in a cell from which it is halved: an extent of 2.4 sd
SHARE = 1e-4  # of the belief: a cell that cannot weigh more may stay coarse
CELLS = 60_000  # are halved no further
TOUCH_SIGMAS = 5.0  # a reading of so many σ is a touch: one of 3·10⁶ silent taxels reads as much
PICKED = 32 * MODE_CANDIDATES  # poses that modes are sought among

BLOCK = 1024  # cells weighed at once: their taxels stay in the cache

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(slots=True)
class Cells:
    """n parallelepipeds of (axis x, axis y [m], turn [rad]): where the skin's axis stands at the
    first touch, as the object sees it, and the object's turn in that sensor's frame."""

    mid: Floats  # (n, 3)
    edge: Floats  # (n, 3, 3) from side to side: along the contact curve, across it, in turn
    log_volume: Floats  # (n,)
    log_like: Floats  # (n,) log-likelihood of the scans, as the cell's poses have it
    log_best: Floats  # (n,) no less than the best of them has
    information: Floats  # (n, 3) Fisher's along each edge, times the variance within the cell

    @classmethod
    def unweighed(cls, mid: Floats, edge: Floats, log_volume: Floats) -> Self:
        n = len(mid)
        return cls(mid, edge, log_volume, np.zeros(n), np.zeros(n), np.zeros((n, 3)))

    def __len__(self) -> int:
        return len(self.mid)

    def __getitem__(self, which: Bools) -> "Cells":
        return Cells(*(getattr(self, field.name)[which] for field in fields(self)))

    @property
    def log_room(self) -> Floats:
        """(n,) log of each cell's volume, or of the likelihood's where that is narrower."""
        return np.asarray(self.log_volume - 0.5 * np.log1p(self.information).sum(axis=1))

    @property
    def weight(self) -> Floats:
        """(n,) prior times likelihood, integrated over each cell; sums to 1."""
        log_mass = self.log_like + self.log_room
        mass = np.exp(log_mass - log_mass.max())
        return np.asarray(mass / mass.sum())

    @property
    def log_may_weigh(self) -> Floats:
        """(n,) log of no less than `weight`, were the best of each cell all of it."""
        log_mass = self.log_like + self.log_room
        total = log_mass.max() + np.log(np.exp(log_mass - log_mass.max()).sum())
        return np.asarray(self.log_best + self.log_room - total)

    def joined(self, other: "Cells") -> "Cells":
        pairs = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return Cells(*(np.concatenate(pair) for pair in pairs))

    def halved(self) -> "Cells":
        """Twice as many, not weighed yet: each cut across the edge of most information."""
        cut = np.arange(len(self)), self.information.argmax(axis=1)
        edge = self.edge.copy()
        edge[cut] *= 0.5
        step = 0.5 * edge[cut]
        mid = np.concatenate([self.mid - step, self.mid + step])
        log_volume = np.tile(self.log_volume - np.log(2.0), 2)
        return Cells.unweighed(mid, np.concatenate([edge, edge]), log_volume)


def lay(model: ObservationModel) -> Cells:
    """The first cells: every pose that presses the silhouette 0..δ_max deep is in one of them."""
    scene = model.scene
    ny, nx = scene.silhouette.shape
    x, y = (scene.origin[i] + scene.cell * np.arange(n) for i, n in enumerate((nx, ny)))
    contours = contourpy.contour_generator(x, y, scene.silhouette)
    layers = max(round(model.depth_max_m / FIRST_DEEP_M), 1)
    deep = model.depth_max_m / layers
    # A level set for each depth instead of one curve's normals: those leave out a wedge at a
    # concave corner, and crowd at a convex one.
    sheets = [
        _along(scene, np.asarray(loop, dtype=np.float64), radius, deep)
        for radius in model.layout.radius_m - (np.arange(layers) + 0.5) * deep
        for loop in contours.lines(radius)
    ]
    turns = round(2.0 * np.pi / FIRST_RAD)
    mid = np.repeat(np.concatenate([sheet[0] for sheet in sheets]), turns, axis=0)
    edge = np.repeat(np.concatenate([sheet[1] for sheet in sheets]), turns, axis=0)
    mid[:, 2] = np.tile((np.arange(turns) + 0.5) * 2.0 * np.pi / turns, len(mid) // turns)
    edge[:, 2, 2] = 2.0 * np.pi / turns
    return Cells.unweighed(mid, edge, np.log(np.abs(np.linalg.det(edge))))


def _along(scene: Scene, loop: Floats, radius_m: float, deep_m: float) -> tuple[Floats, Floats]:
    """Midpoints (n, 3) and edges (n, 3, 3) of cells along a level set, their turn still zero."""
    knots = np.concatenate([[0.0], np.linalg.norm(np.diff(loop, axis=0), axis=1).cumsum()])
    n = max(round(knots[-1] / FIRST_M), 1)
    at, length = (np.arange(n) + 0.5) / n * knots[-1], knots[-1] / n
    axis = np.column_stack([np.interp(at, knots, loop[:, i]) for i in (0, 1)])
    _, gx, gy = scene.clearance(*axis.T)
    tangent = np.column_stack([-gy, gx])
    # Along the curve the object turns with its normal, so that φ stays: it is sharp, and θ, on a
    # corner, is not. At a kink, where there is no such turn, a little is as good as none.
    before, after = (_normal(scene, axis + side * length * tangent) for side in (-0.5, 0.5))
    most = length / (radius_m - deep_m)
    bend = np.clip(se2.wrap(before - after), -most, most)
    edge = np.zeros((n, 3, 3))
    edge[:, 0] = np.column_stack([length * tangent, bend])
    edge[:, 1, :2] = deep_m * np.column_stack([gx, gy])
    return np.column_stack([axis, np.zeros(n)]), edge


def _normal(scene: Scene, points: Floats) -> Floats:
    """Direction (n,) of the silhouette's distance at points (n, 2)."""
    _, gx, gy = scene.clearance(*points.T)
    return np.asarray(np.arctan2(gy, gx))


@dataclass(frozen=True, slots=True)
class Scan:
    """What a sensor at a pose (3,) in the world felt: z (M,), live (M,)."""

    sensor: Poses
    z: Floats
    live: Bools


class Weigher:
    """How well the poses of a cell explain a scan.

    A reading varies within a cell as it does along the cell's three middle lines, from end to end.
    A residual within that range is forgiven: by its variance for what the cell weighs, to its ends
    for the best that the cell may hold. No cell is judged by a peak that its midpoint misses, and
    with small extents both are the likelihood itself.
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

    def weigh(self, cells: Cells, scans: list[Scan], first: Poses) -> None:
        """Add what scans say to the cells, with the sensor's pose (3,) at the first touch."""
        for scan in scans:
            position = self._model.layout.position_m[:, :2]
            taxel = se2.apply(se2.compose(se2.inverse(first), scan.sensor), position)
            silent = np.where(scan.live, self._noise.log_density(scan.z, np.zeros(1)), 0.0)
            for begin in range(0, len(cells), BLOCK):
                block = slice(begin, begin + BLOCK)
                n = len(cells.mid[block])
                row, i, depth, fall, rise = self._near(
                    cells.mid[block], cells.edge[block], taxel, scan.live
                )
                ends = np.clip([depth + fall.sum(axis=0), depth + rise.sum(axis=0)], 0.0, 1.0)
                best = np.clip(scan.z[i], *ends)
                gain = self._noise.log_density(scan.z[i], best) - silent[i]
                cells.log_best[block] += silent.sum() + np.bincount(row, gain, n)
                change = rise - fall
                middle = depth + 0.5 * (fall + rise).sum(axis=0)
                spread = 0.5 * np.sqrt((change**2).sum(axis=0))
                low, high = np.clip([middle - spread, middle + spread], 0.0, 1.0)
                h, blur = 0.5 * (low + high), (high - low) ** 2 / 12.0
                variance = self._noise.sigma**2 + (self._noise.gain_cv * h) ** 2
                off = (scan.z[i] - h) * np.sqrt(variance / (variance + blur))
                gain = self._noise.log_density(h + off, h) - silent[i]
                cells.log_like[block] += silent.sum() + np.bincount(row, gain, n)
                # none of what clipping takes away
                per_change = 0.25 * blur / np.maximum(spread**2, 1e-30) / variance
                for j in range(3):
                    of_edge = change[j] ** 2 * per_change
                    cells.information[block, j] += np.bincount(row, of_edge, n)

    def _near(
        self, mid: Floats, edge: Floats, taxel: Floats, live: Bools
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats, Floats, Floats]:
        """The pairs of n cells and live taxels (M, 2) that may be pressed within the cell: indices
        of both, depth at the midpoint over δ_max, and how much less and more of it (3, pairs) there
        is along the cell's edges."""
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
        half = 0.5 * edge[row].transpose(1, 2, 0)  # (3, 3, pairs)
        eu = half[:, 0] + half[:, 2] * (v - axis[row, 1])
        ev = half[:, 1] - half[:, 2] * (u - axis[row, 0])
        change = (
            np.stack([self._depth(u + eu, v + ev, of), self._depth(u - eu, v - ev, of)]) - depth
        )
        return row, i, depth, change.min(axis=0).clip(max=0.0), change.max(axis=0).clip(min=0.0)

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
        self._weigher = Weigher(model, noise)
        self._most = cells
        self._coarse = coarse
        self._scans: list[Scan] = []
        self._first = se2.IDENTITY  # the sensor's pose at the first touch
        self._cells = Cells.unweighed(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0))

    def __len__(self) -> int:
        return len(self._cells)

    @property
    def pose(self) -> Poses:
        """(n, 3) midpoints of the cells in the world; none before the first touch."""
        ax, ay, turn = self._cells.mid.T
        c, s = np.cos(turn), np.sin(turn)
        seen = np.column_stack([s * ay - c * ax, -s * ax - c * ay, turn])
        return se2.compose(self._first, seen)

    @property
    def weight(self) -> Floats:
        """(n,) of the cells; sums to 1."""
        return self._cells.weight if len(self) else np.empty(0)

    def update(self, sensor: Poses, z: Floats, live: Bools, *, touched: bool | None = None) -> None:
        """Take a scan z (M,), live (M,) with the sensor at a pose (3,) in the world.

        `touched` says whether the object touches the skin, where that is known; None leaves it to
        the readings. It matters until the first touch alone: scans before it wait for it.
        """
        scan = Scan(sensor.copy(), z.copy(), live.copy())
        self._scans.append(scan)
        if len(self):
            self._weigher.weigh(self._cells, [scan], self._first)
            self._settle()
            return
        if touched is None:
            touched = bool(z.max(initial=0.0, where=live) > TOUCH_SIGMAS * self._noise.sigma)
        if touched:
            self._first = scan.sensor
            self._cells = lay(self._model)
            self._weigher.weigh(self._cells, self._scans, self._first)
            self._settle()

    def estimate(self) -> tuple[Poses, Poses]:
        """The mean of the heaviest mode (3,) and of the whole belief (3,), as the daemon's are.

        Raises:
            ValueError: nothing was touched yet.
        """
        if not len(self):
            raise ValueError("no estimate before the first touch")
        # Modes are sought around the heaviest particles. The heaviest cells are the smallest of
        # one peak: equal weights, evenly through the belief, the candidates first.
        pose, weight = self.pose, self.weight
        cumulative = np.cumsum(weight)
        cumulative[-1] = 1.0  # rounding must not leave the last without a cell
        at = (np.arange(PICKED).reshape(MODE_CANDIDATES, -1).T.ravel() + 0.5) / PICKED
        picked = pose[np.searchsorted(cumulative, at)]
        equal = np.full(PICKED, 1.0 / PICKED)
        modes = self.metric.modes(picked, equal, MODE_RADIUS_M, MODES_MAX, MODE_CANDIDATES)
        best = modes[0].pose
        return best, self.metric.mean(pose, weight, best)[0]

    def _settle(self) -> None:
        """Drop the cells that do not matter, halve those that are coarse and weigh much; again."""
        cells = self._cells
        while True:
            cells = cells[cells.log_best >= cells.log_best.max() - DROP_NATS]
            weight = cells.log_may_weigh
            coarse = (cells.information.max(axis=1) > self._coarse) & (weight > np.log(SHARE))
            room = self._most - len(cells)
            if not coarse.any() or room <= 0:
                break
            if coarse.sum() > room:
                coarse &= weight >= np.partition(weight[coarse], -room)[-room]
            parts = cells[coarse].halved()
            self._weigher.weigh(parts, self._scans, self._first)
            cells = cells[~coarse].joined(parts)
        self._cells = cells
