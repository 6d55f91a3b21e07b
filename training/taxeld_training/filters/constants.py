"""Constants of the filter that an ablation changes, one at a time, and how."""

import importlib
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
    Constant("particles", "MOVE", ((0.0005, 0.0005, 0.005), (0.008, 0.008, 0.08))),
    Constant("particles", "RESAMPLE_BELOW", (0.25, 0.9)),
    Constant("injection", "KEPT", (0.1, 0.5)),
    Constant("injection", "STAGES_MAX", (1, 3, 12)),
    Constant("offsets", "HIDDEN", (0.0, 0.75, 3.0)),
    Constant("offsets", "ROBUST", (1.5, 6.0, 1e6)),
    Constant("offsets", "ITERATIONS", (1, 4)),
    Constant("mixture", "MOVES", (0, 1, 4)),
    Constant("mixture", "REMEMBERED", (4, 32)),
    Constant("mixture", "SILENT_MAX", (0, 8, 64)),
    Constant("mixture", "TELLING", (0.0, 3.0)),
    Constant("mixture", "KLD_ERROR", (0.025, 0.1)),
    Constant("mixture", "SCALES", ((0.0, 1.0), (0.0, 0.5, 1.0, 2.0, 4.0))),
    Constant("mixture", "SLACK_FROM", (99,)),  # SCALES are not used
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
