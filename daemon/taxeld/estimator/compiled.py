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
        *((name, c_void_p) for name in ("slices", "pressed", "about", "reach", "place")),
        *((name, c_void_p) for name in ("taxel", "offset")),
        *((name, c_int64) for name in ("nx", "ny", "places", "most", "taxels")),
        *((name, c_double) for name in ("x", "y", "cell", "depth_max", "band", "hidden", "robust")),
        *((name, c_double) for name in ("least_variance", "iterations")),
        *((name, c_double) for name in ("sigma", "gain_cv", "outliers", "least", "farthest")),
        *((name, c_double) for name in ("bowling1", "bowling3")),
    ]


class _Scans(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("kept", "sensor", "variance", "silent")),
        *((name, c_int64) for name in ("scans", "about")),
    ]


class Compiled:
    """The C code for one model and noise."""

    def __init__(self, library: ctypes.CDLL, model: ObservationModel, noise: Noise) -> None:
        self._explain = library.taxeld_explain
        scene = model.scene
        held = {name: np.ascontiguousarray(table) for name, table in model.grid._asdict().items()}
        self._held = held  # what the pointers below point to
        ny, nx = scene.silhouette.shape
        places, most = held["taxel"].shape
        self._model = _Model(
            **{name: table.ctypes.data for name, table in held.items()},
            nx=nx, ny=ny, places=places, most=most, taxels=len(model.layout),
            x=scene.origin[0], y=scene.origin[1], cell=scene.cell, depth_max=model.depth_max_m,
            band=BAND_M, hidden=offsets.HIDDEN, robust=offsets.ROBUST,
            least_variance=offsets.LEAST_M2, iterations=offsets.ITERATIONS,
            sigma=noise.sigma, gain_cv=noise.gain_cv, outliers=noise.outliers, least=noise.least,
            farthest=FARTHEST_SD, bowling1=BOWLING[0], bowling3=BOWLING[1],
        )  # fmt: skip

    def explain(
        self, kept: Grid, sensor: Floats, variance: Floats, silent: Bools, poses: Poses
    ) -> Floats:
        """Readings (FIELDS, K, M) and poses (N, 3) → (N, K), as memory.py has them."""
        poses = np.ascontiguousarray(poses)
        out = np.empty((len(poses), len(sensor)))
        scans = _Scans(
            kept.ctypes.data, sensor.ctypes.data, variance.ctypes.data, silent.ctypes.data,
            len(sensor), bool(variance.any()),
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
