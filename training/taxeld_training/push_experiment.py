"""`taxeld-train evaluate push`: a located object is pushed, with and without a prior of its way."""

from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from taxeld import se2
from taxeld.config import FilterConfig
from taxeld.errors import SetupError
from taxeld.estimate import Status
from taxeld.estimator import Estimator
from taxeld.observation import Noise
from taxeld.symmetry import add_m
from taxeld_training import experiment, follow, trained
from taxeld_training.cells import COLUMNS, setting_of
from taxeld_training.evaluate import Options, run_jobs, write
from taxeld_training.experiment import Setting
from taxeld_training.follow import OWN_SEEDS, SILENT_MM
from taxeld_training.jobs import Job
from taxeld_training.pusher import TOUCHES, PushedTrial
from taxeld_training.trained import DENSITY

OBJECTS = ("003_cracker_box", "025_mug")
MOTIONS = ("push", "none")
SEEDS, QUICK_SEEDS, BLOCK = 100, 2, 20


def run(options: Options) -> list[Path]:
    """Rows {object, motion, moved_mm, turned_deg, path_mm and end_mm{q10, median, q90},
    silent_failure_rate, seeds}: errors over the push, and at its end.

    Raises:
        SetupError: an object without a shipped bundle.
    """
    objects = OBJECTS if options.objects == experiment.OBJECTS else options.objects
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    for name in objects:
        if trained.shipped(setting_of(name, COLUMNS, options)) is None:
            raise SetupError(f"--objects: {name} has no shipped bundle; push takes those that have")
    cells = [(setting_of(name, COLUMNS, options), motion) for name in objects for motion in MOTIONS]
    todo = {
        cell: [
            Job(
                f"push-{cell[0].name}-{cell[1]}-{first}", play,
                (*cell, first, min(BLOCK, seeds - first), follow.code(DENSITY)),
            )
            for first in range(0, seeds, BLOCK)
        ]
        for cell in cells
    }  # fmt: skip
    done = run_jobs([job for each in todo.values() for job in each], options)
    rows = []
    for (setting, motion), each in todo.items():
        told = [trial for job in each for trial in done[job.name] or []]
        if told:
            rows.append(_row(setting.object, motion, told))
    return [write(options, "push", rows)]


def play(setting: Setting, motion: str, first: int, count: int, code: str) -> list[dict[str, Any]]:
    """Of each trial: how far the object went, and the errors [mm] during the push."""
    del code
    model = trained.model_of(setting)
    proposal = trained.proposal_of(DENSITY, setting, "")
    told = []
    for seed in range(first, first + count):
        config = FilterConfig(motion=motion, noise_sigma=Noise().sigma, seed=OWN_SEEDS + seed)
        estimator = Estimator(model, proposal, config)
        errors = []
        for touch, scans in groupby(PushedTrial(model, seed), key=lambda scan: scan.touch):
            for scan in scans:
                said = estimator.on_scan(scan.activation, scan.sensor)
                if touch == TOUCHES and scan.activation.z.any():
                    errors.append(1e3 * add_m(model.scene, said.map, scan.truth)[1])
            if touch < TOUCHES:
                start = scan.truth
        gap = se2.compose(se2.inverse(start), scan.truth)
        told.append({
            "moved_mm": 1e3 * float(np.hypot(gap[0], gap[1])),
            "turned_deg": float(np.degrees(abs(gap[2]))),
            "path_mm": float(np.median(errors)),
            "end_mm": errors[-1],
            "silent": said.status is Status.CONVERGED and errors[-1] > SILENT_MM,
        })  # fmt: skip
    return told


def _row(name: str, motion: str, told: list[dict[str, Any]]) -> dict[str, Any]:
    def quantiles(key: str) -> dict[str, float]:
        low, median, high = np.quantile([each[key] for each in told], [0.1, 0.5, 0.9]).tolist()
        return {"q10": round(low, 2), "median": round(median, 2), "q90": round(high, 2)}

    return {
        "object": name,
        "motion": motion,
        "moved_mm": quantiles("moved_mm"),
        "turned_deg": quantiles("turned_deg"),
        "path_mm": quantiles("path_mm"),
        "end_mm": quantiles("end_mm"),
        "silent_failure_rate": float(np.mean([each["silent"] for each in told])),
        "seeds": len(told),
    }
