"""Trials by touch: the shares that are found, sure and misleading after each."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from taxeld_training.filters.methods import TouchResult

DUE = 0.9  # share of trials that are to be found and sure


def by_touch(trials: Sequence[Sequence[TouchResult]]) -> dict[str, Any]:
    """Shares of trials after each touch, after how many `DUE` of them are found and sure, and how
    many estimates mislead."""
    found, right, misleading = (
        np.array([[getattr(touch, rule) for touch in trial] for trial in trials], dtype=float)
        for rule in ("found", "is_right", "misleading")
    )
    due = np.flatnonzero(right.mean(axis=0) >= DUE)
    return {
        "trials": len(trials),
        "found": found.mean(axis=0).round(4).tolist(),
        "found_and_sure": right.mean(axis=0).round(4).tolist(),
        "touches_to_90": int(due[0]) + 1 if len(due) else None,
        "misleading": int(misleading.sum()),
    }
