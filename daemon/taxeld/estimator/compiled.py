"""Explains scans in C (explain.c), where it was compiled (`taxeld.native`): as likelihood.py does
but for rounding, and without temporary arrays."""

import ctypes
import math
from collections.abc import Sequence
from ctypes import c_double, c_int64, c_void_p
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld import native
from taxeld.arrays import Bools, Floats, Grid, Index, Poses
from taxeld.estimator import likelihood
from taxeld.estimator.likelihood import Explain, NumpyExplainer
from taxeld.model.noise import BOWLING, FARTHEST_SD, Noise
from taxeld.model.observation import BAND_M, ObservationModel
from taxeld.model.response import FARTHEST_RATES, LEAST_RATE

FIELDS = 9  # of `scans.Field`, the first ones, that the C code reads
SHARED = "far", "hidden", "robust", "clear", "steps", "enough", "most", "least_m2"
LANES = 8  # lanes of the C code's vectors


class _Model(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("distance", "pressed", "about", "reach", "place")),
        *((name, c_void_p) for name in ("first", "height", "size")),
        *((name, c_int64) for name in ("nx", "ny", "heights", "runs", "taxels")),
        *((name, c_double) for name in ("x", "y", "cell", "depth_max", "band", *SHARED)),
        *((name, c_double) for name in ("outliers", "least", "farthest", "bowling1", "bowling3")),
        *((name, c_double) for name in ("least_rate", "farthest_rates")),
    ]


class _Scans(ctypes.Structure):
    _fields_ = [
        *((name, c_void_p) for name in ("kept", "sensor", "variance", "silent")),
        ("scans", c_int64),
    ]


def _runs(model: ObservationModel) -> tuple[Index, dict[str, NDArray[Any]]]:
    """The taxels (M,) in runs of at most `LANES` at one place and in consecutive slices, each of
    which C looks up by one vector; and where runs begin in them, sizes, places and first slices."""
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
    of_run = {"first": begins, "size": np.diff(begins, append=len(order)), "height": height[begins]}
    return order, {"place": model.grid.place[:2, place[begins]], **of_run}


class CompiledExplainer:
    """The C code for one model and noise."""

    def __init__(self, library: ctypes.CDLL, model: ObservationModel, noise: Noise) -> None:
        self._explain = library.taxeld_explain
        scene, grid = model.scene, model.grid
        self._order, runs = _runs(model)
        distance = np.moveaxis(scene.slices, 0, -1)
        tables = {
            "distance": np.append(distance, np.zeros(LANES, np.float32)),
            **{name: getattr(grid, name) for name in ("pressed", "about", "reach")},
            **runs,
        }
        held = {name: np.ascontiguousarray(table) for name, table in tables.items()}
        self._held = held  # arrays that the pointers below point into, kept alive
        heights, ny, nx = scene.slices.shape
        self._model = _Model(
            **{name: table.ctypes.data for name, table in held.items()},
            nx=nx,
            ny=ny,
            heights=heights,
            runs=len(runs["first"]),
            taxels=len(model.layout),
            x=scene.origin[0],
            y=scene.origin[1],
            cell=scene.cell,
            depth_max=model.depth_max_m,
            band=BAND_M,
            **{name: getattr(likelihood, name.upper()) for name in SHARED},
            outliers=noise.outliers,
            least=noise.least,
            farthest=FARTHEST_SD,
            bowling1=BOWLING[0],
            bowling3=BOWLING[1],
            least_rate=LEAST_RATE,
            farthest_rates=FARTHEST_RATES,
        )

    def column(self, fields: Grid) -> Grid:
        """The first `FIELDS` of a scan's fields (…, M) in the order of the runs."""
        return fields[:FIELDS].take(self._order, axis=1)

    def of(
        self, columns: Sequence[Grid], sensor: Poses, variance: Floats, silent: Bools
    ) -> Explain:
        """As `NumpyExplainer.of`."""
        shape = FIELDS, len(columns), len(self._order)
        laid = np.zeros(math.prod(shape) + LANES, np.float32)  # C may read LANES beyond
        np.stack(columns, axis=1, out=laid[:-LANES].reshape(shape))
        held = laid, sensor, variance, silent  # arrays that the pointers point into, kept alive
        scans = _Scans(*(array.ctypes.data for array in held), len(sensor))

        def explained(poses: Poses) -> Floats:
            poses = np.ascontiguousarray(poses)
            found = np.empty((len(poses), len(held[1])))
            failed = self._explain(
                ctypes.byref(self._model),
                ctypes.byref(scans),
                c_void_p(poses.ctypes.data),
                c_int64(len(poses)),
                c_void_p(found.ctypes.data),
            )
            if failed:
                raise MemoryError("no memory to explain scans in")
            return found

        return explained


Explainer = CompiledExplainer | NumpyExplainer


def explainer(model: ObservationModel, noise: Noise) -> Explainer:
    """The C code for this model, or numpy where it was not compiled."""
    library = native.library("estimator/explain")
    if library is None:
        return NumpyExplainer(model, noise)
    return CompiledExplainer(library, model, noise)
