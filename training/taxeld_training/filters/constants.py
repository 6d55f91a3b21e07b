"""Constants of the filter that an ablation changes, one at a time, and how."""

import importlib
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from taxeld.errors import SetupError

PACKAGE = "taxeld.estimator"

Value: TypeAlias = float | tuple[float, ...]  # a tuple stands for an array


class Change(NamedTuple):
    """A constant, and its value in place of the one that ships."""

    module: str  # in `PACKAGE`
    name: str
    value: Value


@dataclass(frozen=True)
class Constant:
    """A constant by the module that defines it, and values to try."""

    module: str  # in `PACKAGE`
    name: str
    values: tuple[Value, ...]

    @property
    def label(self) -> str:
        return f"{self.module}.{self.name}"

    @property
    def changes(self) -> list[Change]:
        """A change for each value."""
        return [Change(self.module, self.name, value) for value in self.values]


CONSTANTS = (
    Constant("anything", "SHAPES", (96, 1536)),
    Constant("anything", "SIDE_RAD", (math.radians(5.0), math.radians(30.0))),
    Constant("anything", "NEAR_RAD", (math.radians(45.0), math.radians(90.0))),
    Constant("anything", "BEND", (100.0, 400.0)),
    Constant("anything", "SLOPE_SD", (0.05, 0.45)),
    Constant("anything", "BOW", (0.0, 40.0)),
    Constant("evidence", "FINE", ((0.002, 0.002, 0.03), (0.008, 0.008, 0.12))),
    Constant("evidence", "OTHER", (-3.0, 1.0)),
    Constant("evidence", "ALIKE", (0.0, 1.5, 6.0)),
    Constant("runs", "HAZARD", (2e-4, 2e-2)),
    Constant("runs", "MEANINGLESS", (1e-6, 1e-2)),
    Constant("verdict", "UNMODELLED_M", (0.001, 0.004)),
    Constant("estimate", "MODE_RADIUS_M", (0.01, 0.04)),
    Constant("particles", "MOVE", ((0.0005, 0.0005, 0.005), (0.008, 0.008, 0.08))),
    Constant("particles", "RESAMPLE_BELOW", (0.25, 0.9)),
    Constant("particles", "KLD_ERROR", (0.025, 0.1)),
    Constant("injection", "KEPT", (0.1, 0.5)),
    Constant("injection", "STAGES_MAX", (1, 3)),
    Constant("offsets", "HIDDEN", (0.0, 0.75, 3.0)),
    Constant("offsets", "ROBUST", (1.5, 6.0, 1e6)),
    Constant("offsets", "ITERATIONS", (1, 4)),
    Constant("mixture", "MOVES", (0, 1, 4)),
    Constant("mixture", "REMEMBERED", (2, 4)),
    Constant("mixture", "SILENT_MAX", (0, 8)),
    Constant("mixture", "TELLING", (0.0, 3.0)),
    Constant("mixture", "SCALES", ((0.0, 1.0), (0.0, 0.5, 1.0, 2.0, 4.0))),
    Constant("mixture", "SLACK_NATS", (0.0, 3.0, 1e9)),  # at last SCALES are not used
    Constant("mixture", "REVISITS", (0, 1, 6)),
    Constant("mixture", "AGREED", (1, 4)),
    Constant("mixture", "MISSED", (0.0, 0.1)),
)


@contextmanager
def changed(change: Change | None) -> Iterator[None]:
    """The filter with a change, in this process; no change: as it ships.

    A module that imported the constant by name has it changed as well. A default argument would
    keep its value; a test sees that each constant of the table matters.

    Raises:
        SetupError: there is no such constant.
    """
    if change is None:
        yield
        return
    before = shipped(change.module, change.name)
    value = np.array(change.value) if isinstance(before, np.ndarray) else change.value
    users = [
        module
        for name, module in sys.modules.items()
        if name.startswith(f"{PACKAGE}.") and vars(module).get(change.name) is before
    ]
    for module in users:
        setattr(module, change.name, value)
    try:
        yield
    finally:
        for module in users:
            setattr(module, change.name, before)


def shipped(module: str, name: str) -> Any:
    """A constant's value as it ships.

    Raises:
        SetupError: there is no such constant.
    """
    try:
        return getattr(importlib.import_module(f"{PACKAGE}.{module}"), name)
    except (ImportError, AttributeError):
        raise SetupError(f"{PACKAGE}.{module} has no {name}; bring CONSTANTS up to date") from None
