"""`Memory.explain` in C (explain.c), used where it was compiled (`taxeld.native`).

It computes the same as the numpy code of memory.py, without temporary arrays, and equals it but for
rounding.
"""

import ctypes
import math
from ctypes import c_double, c_int64, c_void_p
from typing import NamedTuple

import numpy as np

from taxeld import native
from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator import offsets
from taxeld.model.noise import BOWLING, FARTHEST_SD, Noise
from taxeld.model.observation import BAND_M, ObservationModel
from taxeld.model.response import FARTHEST_RATES, LEAST_RATE

FIELDS = 8  # fields of `memory.Kept` that the C code reads
LANES = 8  # lanes of the C code's vectors


class _Model(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("distance", "pressed", "about", "reach", "place")),
        *((name, c_void_p) for name in ("first", "height", "size")),
        *((name, c_int64) for name in ("nx", "ny", "heights", "runs", "taxels")),
        *((name, c_double) for name in ("x", "y", "cell", "depth_max", "band", "hidden", "robust")),
        *((name, c_double) for name in ("least_variance", "iterations")),
        *((name, c_double) for name in ("outliers", "least", "farthest", "bowling1", "bowling3")),
        *((name, c_double) for name in ("least_rate", "farthest_rates")),
    ]


class _Scans(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("kept", "sensor", "variance", "silent")),
        ("scans", c_int64),
    ]


class Scans(NamedTuple):
    """Scans in the layout of the C code."""

    told: _Scans
    held: tuple[object, ...]  # arrays that the pointers point into, kept alive


class _Runs(NamedTuple):
    """Runs of taxels at one place, in consecutive slices: C looks up a run by one vector."""

    order: Index  # (M,) taxels, run by run
    first: Index  # (R,) where in `order` each run begins
    size: Index  # (R,) taxels in the run, at most `LANES`
    place: Index  # (R,) column of the place
    height: Index  # (R,) slice of the run's first taxel


def _runs(model: ObservationModel) -> _Runs:
    taxel = model.grid.taxel
    here = np.flatnonzero(taxel >= 0)
    order, place = taxel.ravel()[here], here // taxel.shape[1]
    height = (model.grid.offset // model.scene.silhouette.size).ravel()[here]
    sort = np.lexsort((height, place))
    order, place, height = order[sort], place[sort], height[sort]
    follows = (np.diff(place) == 0) & (np.diff(height) == 1)
    first = [0]
    for at, in_run in enumerate(follows.tolist(), 1):
        if not in_run or at - first[-1] == LANES:
            first.append(at)
    begins = np.array(first)
    return _Runs(order, begins, np.diff(begins, append=len(order)), place[begins], height[begins])


class Compiled:
    """The C code for one model and noise."""

    def __init__(self, library: ctypes.CDLL, model: ObservationModel, noise: Noise) -> None:
        self._explain = library.taxeld_explain
        scene, grid = model.scene, model.grid
        runs, distance = _runs(model), np.moveaxis(scene.slices, 0, -1)
        tables = {
            "distance": np.append(distance, np.zeros(LANES, np.float32)),
            "place": grid.place[:2, runs.place],
            **{name: getattr(grid, name) for name in ("pressed", "about", "reach")},
            **{name: getattr(runs, name) for name in ("first", "height", "size")},
        }
        held = {name: np.ascontiguousarray(table) for name, table in tables.items()}
        self._held = held  # arrays that the pointers below point into, kept alive
        heights, ny, nx = scene.slices.shape
        self._order = runs.order
        self._model = _Model(
            **{name: table.ctypes.data for name, table in held.items()},
            nx=nx,
            ny=ny,
            heights=heights,
            runs=len(runs.first),
            taxels=len(model.layout),
            x=scene.origin[0],
            y=scene.origin[1],
            cell=scene.cell,
            depth_max=model.depth_max_m,
            band=BAND_M,
            hidden=offsets.HIDDEN,
            robust=offsets.ROBUST,
            least_variance=offsets.LEAST_M2,
            iterations=offsets.ITERATIONS,
            outliers=noise.outliers,
            least=noise.least,
            farthest=FARTHEST_SD,
            bowling1=BOWLING[0],
            bowling3=BOWLING[1],
            least_rate=LEAST_RATE,
            farthest_rates=FARTHEST_RATES,
        )

    def scans(self, kept: Grid, sensor: Floats, variance: Floats, silent: Bools) -> Scans:
        """Readings `kept` (FIELDS or more, K, M) taken at the sensor's poses (K, 3). `variance`
        (K,) of the offsets is in m²; `silent` (K,)."""
        shape = FIELDS, *kept.shape[1:]
        laid = np.zeros(math.prod(shape) + LANES, np.float32)
        out = laid[:-LANES].reshape(shape)
        np.take(kept[:FIELDS], self._order, axis=2, out=out, mode="clip")  # avoids a copy
        told = _Scans(
            laid.ctypes.data,
            sensor.ctypes.data,
            variance.ctypes.data,
            silent.ctypes.data,
            len(sensor),
        )
        return Scans(told, (laid, sensor, variance, silent))

    def explain(self, scans: Scans, poses: Poses) -> Floats:
        """K scans and poses (N, 3) → (N, K), as memory.py computes them."""
        poses = np.ascontiguousarray(poses)
        out = np.empty((len(poses), scans.told.scans))
        failed = self._explain(
            ctypes.byref(self._model),
            ctypes.byref(scans.told),
            c_void_p(poses.ctypes.data),
            c_int64(len(poses)),
            c_void_p(out.ctypes.data),
        )
        if failed:
            raise MemoryError("no memory to explain scans in")
        return out


def compiled(model: ObservationModel, noise: Noise) -> Compiled | None:
    """The C code for this model; None where it was not compiled, so that numpy does the work."""
    library = native.library("estimator/explain")
    return None if library is None else Compiled(library, model, noise)
