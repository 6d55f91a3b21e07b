"""Readings, and the observation model: how deep an object at a pose presses each taxel.

h(q)_i = clip(−σ_k(i)(q⁻¹ p_i) / δ_max, 0, 1); `noise` says how readings err about it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Grid, Index, Poses, Reals
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.leak import Leak
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.scene import Scene

BLOCK = 65_536  # points looked up at once: they stay in the cache
BAND_M = 0.005  # m that a pose or a sensor may be off: taxels this far beside a press are looked up
NONE = np.empty(0, np.float32)  # slopes where none are asked for


@dataclass(frozen=True, slots=True)
class Activation:
    """Readings of M taxels at time t [s]."""

    t: float
    z: Floats  # (M,) 0..1, exactly 0 below the taxel's floor
    live: Bools  # (M,) whether the taxel has answered and can be believed
    floor: Floats | float = FLOOR  # (M,) readings below it are 0: noise, and foam's remains
    residue: Floats | float = 0.0  # (M,) part of a reading that earlier presses may have left
    noise: Noise | None = None  # errors of each taxel, where they are known
    place_sd_m: float = 0.0  # of the sensor's place at t, beside what every place is off


@dataclass(frozen=True, slots=True)
class Observation:
    """A scan as evidence: what an activation holds, and the sensor's pose."""

    sensor: Poses  # (3,) sensor's pose in the world
    z: Floats  # (M,) activations, 0 where a taxel is not live
    live: Bools  # (M,)
    floor: Floats | float = FLOOR
    residue: Floats | float = 0.0
    noise: Noise | None = None
    link: int = 0  # number of the link whose skin it is
    place_sd_m: float = 0.0

    @property
    def is_contact(self) -> bool:
        """Whether any taxel was pressed; else the scan is silent."""
        return bool(self.z.max() > 0.0)


class Lesson(NamedTuple):
    """Readings of K contacts beside the depths that a sure belief expects, (K, M) each, in shares
    of full scale: they tell a skin about its taxels."""

    z: Floats  # by the curves in use; 0 under the floor
    floor: Floats  # under which a reading is 0
    h: Floats  # expected depth, with sag
    by_sag: Floats  # slope of h over the logarithm of the sag's length
    variance: Floats  # of the depth about h, by pose, and of what earlier presses may have left
    live: Bools
    share: Floats  # (K,) of each scan in its contact


class Nearby(NamedTuple):
    """Taxels at or near a press, (P,) each, in single precision as all looked-up values."""

    row: Index  # row of the sensor and pose
    taxel: Index
    depth: Grid  # share of full scale; below 0 where the taxel is not reached
    # the slopes of the depth [1/m]; only of taxels that are looked up about a press
    gx: Grid  # over the sensor's x in the object's frame
    gy: Grid  # over the sensor's y
    along: Grid  # around the link


class GridTables(NamedTuple):
    """Flat tables in which a taxel's depth is looked up."""

    slices: Grid  # signed distances of all heights [m]
    pressed: Bools  # (cells,) cells in which a taxel is pressed
    about: Bools  # (cells,) cells in which a taxel is pressed or within BAND_M of it
    reach: Bools  # (cells,) cells of the link's axis at which the link reaches the object
    place: Grid  # (3, P) x, y [m] and 1 of each place, as columns
    taxel: Index  # (P, most) taxels at the place, −1 where there are fewer
    offset: Index  # (P, most) where each taxel's slice begins


class ObservationModel:
    """h(q) of one scene on one skin, vectorised over poses.

    A pose presses few taxels, so all work beyond finding those few is done on them alone.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        depth_max_m: float,
        further: Sequence["ObservationModel"] = (),
    ) -> None:
        """`further`: of the same object on further links."""
        self.links = (self, *further)
        self.scene = scene
        self.layout = layout
        self.depth_max_m = depth_max_m
        self.leak = Leak(layout)
        place, group = np.unique(layout.position_m[:, :2], axis=0, return_inverse=True)
        columns = [np.flatnonzero(group == k).tolist() for k in range(len(place))]
        taxel = np.array([*zip(*zip_longest(*columns, fillvalue=-1), strict=True)])
        farthest = float(np.hypot(*place.T).max()) + 1.5 * scene.cell
        self.grid = GridTables(
            slices=scene.slices.ravel(),
            pressed=_touched(scene.silhouette, 0.0),
            about=_touched(scene.silhouette, BAND_M),
            reach=(scene.silhouette < farthest + BAND_M).ravel(),
            place=np.vstack([place.T, np.ones(len(place))]).astype(np.float32),
            taxel=taxel,
            offset=scene.slice_of(layout)[taxel] * scene.silhouette.size,
        )

    def pressed(self, poses: Floats) -> tuple[Index, Grid]:
        """The taxels pressed by the object at poses (N, 3) in the sensor frame: flat indices (P,)
        into (N, M), and their h > 0 (P,)."""
        near = self.near(se2.inverse(poses))
        return near.row * len(self.layout) + near.taxel, np.minimum(near.depth, 1.0)

    def activation(self, poses: Floats) -> Floats:
        """h: poses (N, 3) of the object in the sensor frame → (N, M) in 0..1."""
        h = np.zeros((len(poses), len(self.layout)))
        at, values = self.pressed(poses)
        h.flat[at] = values
        return h

    def near(self, sensors: Poses, band_m: Floats | None = None) -> Nearby:
        """The taxels that the object presses, with the sensor at poses (N, 3) in its frame; those
        within `band_m` (N,), at least BAND_M, of being pressed, where it is given."""
        reached = np.flatnonzero(self.reaches(sensors, 0.0 if band_m is None else band_m))
        size = max(BLOCK // len(self.grid.taxel), 1)
        blocks = [
            self._look_up(reached[at : at + size], sensors, band_m)
            for at in range(0, max(len(reached), 1), size)
        ]
        return Nearby(*(np.concatenate(part) for part in zip(*blocks, strict=True)))

    def reaches(self, sensors: Poses, band_m: Floats | float) -> Bools:
        """(N,) whether the link may come within BAND_M of the object, or within a larger band."""
        x, y = ((sensors[:, :2] - self.scene.origin) / self.scene.cell).T
        return np.asarray(self.grid.reach.take(self._cell(x, y)) | (band_m > BAND_M))

    def _cell(self, u: Reals, v: Reals) -> Index:
        """The grid's cells that hold points (u, v), in cells from the grid's origin; u and v are of
        one shape, and so is the result."""
        ny, nx = self.scene.silhouette.shape
        column = np.minimum(np.maximum(u, 0.0), nx - 1.001).astype(np.int32)
        row = np.minimum(np.maximum(v, 0.0), ny - 1.001).astype(np.int32)
        return np.asarray(row * nx + column, dtype=np.intp)

    def _look_up(self, rows: Index, sensors: Poses, band_m: Floats | None) -> Nearby:
        """`near` for a block of `rows` (n,)."""
        scene, most = self.scene, self.grid.taxel.shape[1]
        ny, nx = scene.silhouette.shape
        (x, y), turn = ((sensors[rows, :2] - scene.origin) / scene.cell).T, sensors[rows, 2]
        cos, sin = np.cos(turn) / scene.cell, np.sin(turn) / scene.cell
        u: Grid = np.array([cos, -sin, x], np.float32).T @ self.grid.place
        v: Grid = np.array([sin, cos, y], np.float32).T @ self.grid.place
        cell = self._cell(u, v)
        band = np.zeros(1) if band_m is None else band_m[rows]
        near = (self.grid.pressed if band_m is None else self.grid.about).take(cell)
        at = np.flatnonzero(near | (band > BAND_M)[:, None])
        row, place = np.divmod(at, len(self.grid.taxel))
        u = np.minimum(np.maximum(u.take(at), 0.0), nx - 1.001)[:, None]
        v = np.minimum(np.maximum(v.take(at), 0.0), ny - 1.001)[:, None]
        ux, uy = u - x.take(row)[:, None], v - y.take(row)[:, None]  # the taxel from the axis
        u -= np.floor(u)
        v -= np.floor(v)
        cell = cell.take(at)[:, None] + self.grid.offset.take(place, axis=0)
        d00, d01, d10, d11 = (self.grid.slices.take(cell + step) for step in (0, 1, nx, nx + 1))
        d01 -= d00  # difference along x, on either side
        d11 -= d10
        d00 += d01 * u
        d10 += d11 * u
        d10 -= d00  # difference along y
        d00 += d10 * v  # the distance itself
        taxel = self.grid.taxel.take(place, axis=0)
        kept = np.flatnonzero((taxel >= 0) & (d00 < band.take(row, mode="clip")[:, None]))
        taxel, place = taxel.take(kept), kept // most
        rows, depth = rows.take(row.take(place)), d00.take(kept) * (-1.0 / self.depth_max_m)
        if band_m is None:
            return Nearby(rows, taxel, depth, NONE, NONE, NONE)
        d11 -= d01
        d11 *= v
        d01 += d11
        rate = -1.0 / (scene.cell * self.depth_max_m)
        gx, gy = d01.take(kept) * rate, d10.take(kept) * rate
        ux, uy = (side.take(place).astype(np.float32) for side in (ux, uy))
        along = np.abs(gy * ux - gx * uy) / np.sqrt(ux * ux + uy * uy)
        return Nearby(rows, taxel, depth, gx, gy, along)


def _touched(silhouette: Grid, band_m: float) -> Bools:
    """(cells,) cells of the grid with a corner so near the object that a taxel there counts."""
    inside = silhouette < band_m
    near = np.zeros_like(inside)
    near[:-1, :-1] = inside[:-1, :-1] | inside[:-1, 1:] | inside[1:, :-1] | inside[1:, 1:]
    return near.ravel()
