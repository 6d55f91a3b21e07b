"""`taxeld-train evaluate push`: a located object is pushed, with and without a motion model."""

from pathlib import Path
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld_training.filters import follow, methods, trained
from taxeld_training.filters.cells import COLUMNS, setting_of
from taxeld_training.filters.figures import quantiles
from taxeld_training.filters.pusher import PushedTrial
from taxeld_training.filters.trained import DENSITY
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.objects.setting import Setting

OBJECTS = ("003_cracker_box", "025_mug")
MOTIONS = ("push", "none")
SEEDS, QUICK_SEEDS, BLOCK = 100, 2, 20


def run(options: Options) -> list[Path]:
    """Rows {object, motion, moved_mm, turned_deg, path_mm and end_mm{q10, median, q90},
    silent_failure_rate, seeds}: errors over the push, and at its end.

    Raises:
        SetupError: an object without a shipped bundle.
    """
    objects = options.objects or OBJECTS
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    for name in objects:
        if trained.shipped(setting_of(name, COLUMNS, options)) is None:
            raise SetupError(f"--objects: {name} has no shipped bundle; push takes those that have")
    cells = [(setting_of(name, COLUMNS, options), motion) for name in objects for motion in MOTIONS]
    todo = {
        cell: [
            Job(
                f"push-{cell[0].name}-{cell[1]}-{first}", play,
                (*cell, first, min(BLOCK, seeds - first), methods.code(DENSITY)),
            )
            for first in range(0, seeds, BLOCK)
        ]
        for cell in cells
    }  # fmt: skip
    done = run_jobs([job for each in todo.values() for job in each], options)
    rows = []
    for (setting, motion), each in todo.items():
        trials = [trial for job in each for trial in done[job.name] or []]
        if trials:
            rows.append(_row(setting.object, motion, trials))
    return [write(options, "push", rows)]


def play(setting: Setting, motion: str, first: int, count: int, code: str) -> list[dict[str, Any]]:
    """The results of trials as `follow_push` has them; `code` is part of the job's key alone."""
    del code
    model = trained.model_of(setting)
    proposal = trained.proposal_of(DENSITY, setting, "")
    seeds = range(first, first + count)
    return [follow.follow_push(PushedTrial(model, seed), motion, proposal) for seed in seeds]


def _row(name: str, motion: str, trials: list[dict[str, Any]]) -> dict[str, Any]:
    spread = {
        key: quantiles([trial[key] for trial in trials], 2)
        for key in ("moved_mm", "turned_deg", "path_mm", "end_mm")
    }
    return {
        "object": name,
        "motion": motion,
        **spread,
        "silent_failure_rate": float(np.mean([trial["silent"] for trial in trials])),
        "seeds": len(trials),
    }
