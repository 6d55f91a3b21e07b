"""`taxeld-train evaluate push`: a located object is pushed, with and without a motion model, and
with one that knows what the object rests on, which is the limit."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from taxeld.errors import SetupError
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import Mixture
from taxeld.model.contacts import Proposal
from taxeld_hil.integrity import is_misleading
from taxeld_training.filters import methods, pushing
from taxeld_training.filters.cells import COLUMNS, setting_of
from taxeld_training.filters.follow import OWN_SEEDS, error_mm
from taxeld_training.filters.pushing import PushedTrial, by_ground
from taxeld_training.jobs import blocks
from taxeld_training.jobs.options import Options, write
from taxeld_training.jobs.statistics import of_count, of_median, quantiles, rounded
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained
from taxeld_training.samplers.trained import DENSITY

OBJECTS = ("003_cracker_box", "025_mug")
TOLD = "told"
MOTIONS = ("push", "none", TOLD)
SEEDS, QUICK_SEEDS = 200, 2

BLOCK = 20  # seeds a job

Trials: TypeAlias = list[dict[str, Any]]  # as `follow_push` has them


@dataclass(frozen=True)
class Pushed:
    """Trials of an object under a filter's motion, of `MOTIONS`."""

    setting: Setting
    motion: str

    @property
    def name(self) -> str:
        return f"{self.setting.name} {self.motion}"


def push_rows(options: Options) -> list[Path]:
    """Rows {object, motion, path_mm{q10, median, q90}, path_mm_ci, misleading_rate and _ci,
    seeds}: errors over the push, and the share of estimates that mislead at its end.

    Raises:
        SetupError: an object without a shipped bundle.
    """
    objects = options.objects or OBJECTS
    seeds = options.seeds or (QUICK_SEEDS if options.quick else SEEDS)
    for name in objects:
        if trained.shipped(setting_of(name, COLUMNS, options)) is None:
            raise SetupError(f"--objects: {name} has no shipped bundle; push takes those that have")
    wanted = {
        Pushed(setting_of(name, COLUMNS, options), motion): seeds
        for name in objects
        for motion in MOTIONS
    }
    done = blocks.trials(wanted, play, options, BLOCK)
    rows = [_row(of, [*trials.values()]) for of, trials in done.items()]
    return [write(options, "push", rows)]


def play(of: Pushed, first: int, count: int) -> Trials:
    """The results of the trials of `count` seeds."""
    model = trained.model_of(of.setting)
    proposal = trained.proposal_of(DENSITY, of.setting, "")
    return [
        follow_push(PushedTrial(model, seed), of.motion, proposal)
        for seed in range(first, first + count)
    ]


def follow_push(trial: PushedTrial, motion: str, proposal: Proposal) -> dict[str, Any]:
    """A filter's median error [mm] during a push, and whether its estimate misleads at the end;
    `motion` is the filter's, or TOLD: it knows the trial's ground."""
    is_told = motion == TOLD
    config = methods.SHIPPED.config(OWN_SEEDS + trial.seed, "push" if is_told else motion)
    estimator = Estimator(trial.model, proposal, config)
    if is_told and isinstance(estimator.rule, Mixture):
        estimator.rule.push = by_ground(trial.ground)
    errors = []
    for moment in trial:
        estimate = estimator.on_scan(moment.activation, moment.sensor)
        if moment.touch == pushing.TOUCHES and moment.activation.z.any():
            errors.append(error_mm(trial.model, moment, estimate.map))
    misleading = is_misleading(estimate.p, errors[-1], 1e3 * estimate.radius_m)
    return {"path_mm": float(np.median(errors)), "misleading": bool(misleading)}


def _row(of: Pushed, trials: Trials) -> dict[str, Any]:
    values = [trial["path_mm"] for trial in trials]
    misleading = [bool(trial["misleading"]) for trial in trials]
    return {
        "object": of.setting.object,
        "motion": of.motion,
        "path_mm": quantiles(values, 2),
        "path_mm_ci": rounded(of_median(values, np.random.default_rng(0)), 2),
        "misleading_rate": float(np.mean(misleading)),
        "misleading_ci": rounded(of_count(sum(misleading), len(misleading))),
        "seeds": len(trials),
    }
