"""`Memory.explain` in C (explain.c): what the numpy code of memory.py does, without its temporary
arrays, where it was compiled (`taxeld.native`). Both are equal but for rounding."""

import ctypes
from ctypes import c_double, c_int64, c_void_p

import numpy as np

from taxeld import native
from taxeld.arrays import Bools, Floats, Grid, Poses
from taxeld.estimator import offsets
from taxeld.model.observation import (
    BAND_M,
    BOWLING,
    FARTHEST_SD,
    Noise,
    ObservationModel,
)


class _Model(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("distance", "pressed", "about", "reach", "place")),
        *((name, c_void_p) for name in ("taxel", "height")),
        *((name, c_int64) for name in ("nx", "ny", "heights", "places", "most", "taxels")),
        *((name, c_double) for name in ("x", "y", "cell", "depth_max", "band", "hidden", "robust")),
        *((name, c_double) for name in ("least_variance", "iterations")),
        *((name, c_double) for name in ("sigma", "gain_cv", "outliers", "least", "farthest")),
        *((name, c_double) for name in ("bowling1", "bowling3")),
    ]


class _Scans(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("kept", "sensor", "variance", "silent")),
        *((name, c_int64) for name in ("scans", "all", "about")),
    ]


class Compiled:
    """The C code for one model and noise."""

    def __init__(self, library: ctypes.CDLL, model: ObservationModel, noise: Noise) -> None:
        self._explain = library.taxeld_explain
        scene, grid = model.scene, model.grid
        tables = {
            "distance": np.moveaxis(scene.slices, 0, -1),  # of a column's taxels side by side
            "height": grid.offset // scene.silhouette.size,
            **{name: getattr(grid, name) for name in ("pressed", "about", "reach")},
            **{name: getattr(grid, name) for name in ("place", "taxel")},
        }
        held = {name: np.ascontiguousarray(table) for name, table in tables.items()}
        self._held = held  # what the pointers below point to
        heights, ny, nx = scene.slices.shape
        places, most = grid.taxel.shape
        self._model = _Model(
            **{name: table.ctypes.data for name, table in held.items()},
            nx=nx, ny=ny, heights=heights, places=places, most=most, taxels=len(model.layout),
            x=scene.origin[0], y=scene.origin[1], cell=scene.cell, depth_max=model.depth_max_m,
            band=BAND_M, hidden=offsets.HIDDEN, robust=offsets.ROBUST,
            least_variance=offsets.LEAST_M2, iterations=offsets.ITERATIONS,
            sigma=noise.sigma, gain_cv=noise.gain_cv, outliers=noise.outliers, least=noise.least,
            farthest=FARTHEST_SD, bowling1=BOWLING[0], bowling3=BOWLING[1],
        )  # fmt: skip

    def explain(
        self, kept: Grid, sensor: Floats, variance: Floats, silent: Bools, poses: Poses
    ) -> Floats:
        """Readings (FIELDS, all, M), of which the last K are of the sensor's poses (K, 3), and
        poses (N, 3) → (N, K), as memory.py has them."""
        poses = np.ascontiguousarray(poses)
        k, (_, scans_kept, taxels) = len(sensor), kept.shape
        out = np.empty((len(poses), k))
        first = kept.itemsize * taxels * (scans_kept - k)
        scans = _Scans(
            kept.ctypes.data + first, sensor.ctypes.data, variance.ctypes.data, silent.ctypes.data,
            k, scans_kept, bool(variance.any()),
        )  # fmt: skip
        failed = self._explain(
            ctypes.byref(self._model),
            ctypes.byref(scans),
            c_void_p(poses.ctypes.data),
            c_int64(len(poses)),
            c_void_p(out.ctypes.data),
        )
        if failed:
            raise MemoryError("no memory to explain scans in")
        return out


def compiled(model: ObservationModel, noise: Noise) -> Compiled | None:
    """None: numpy does it."""
    library = native.library("estimator/explain")
    return None if library is None else Compiled(library, model, noise)
