"""A filter run through a trial: its estimate after each touch, compared with the truth."""

import math
import time
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.mixture import Mixture
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld_hil.integrity import is_misleading
from taxeld_training.filters import gridded, methods, pushing
from taxeld_training.filters.methods import Method, TouchResult
from taxeld_training.filters.pushing import PushedTrial, by_ground
from taxeld_training.filters.trials import SCAN_S, Trial, TrialScan

TOLD = "told"
OWN_SEEDS = 2**31  # added to a trial's seed, so that a filter does not draw what its trial drew


def follow(
    trial: Trial, method: Method, model: ObservationModel, proposal: Proposal | None
) -> list[TouchResult]:
    """The result of each touch, of a method that assumes the object of `model`."""
    if proposal is None:
        return _follow_grid(trial, model, method.touches)
    estimator = Estimator(model, proposal, method.config(OWN_SEEDS + trial.seed))
    found = []
    for _, moments in groupby(trial, key=lambda moment: moment.touch):
        all_s, idle_s = list[float](), list[float]()
        for moment in moments:
            thoughts, began_s = estimator.counters.thoughts, time.process_time()
            now = estimator.on_scan(moment.activation, moment.sensor)
            all_s.append(time.process_time() - began_s)
            if estimator.used is None and estimator.counters.thoughts == thoughts:
                idle_s.append(all_s[-1])
        error_mm = _error_mm(trial, model, moment, now.map)
        promised = now.p, now.radius_m, now.hypotheses
        spent_ms = 1e3 * math.fsum(all_s), 1e3 * float(np.mean(idle_s or math.nan)) / SCAN_S
        found.append(TouchResult(error_mm, now.status, now.particles, *promised, *spent_ms))
    return found


def _follow_grid(
    trial: Trial, model: ObservationModel, touches: Sequence[int]
) -> list[TouchResult]:
    """The result of each touch by the grid filter, which looks after some touches, or after
    each. The trial's own processor time, little beside the grid's, is counted with it."""
    found, began_s = [], time.process_time()
    for moment, grid in gridded.after_touches(trial, model):
        size = len(grid) if not touches or moment.touch + 1 in touches else 0
        error_mm = _error_mm(trial, model, moment, grid.estimate()[0]) if size else math.nan
        spent_ms = 1e3 * (time.process_time() - began_s)
        found.append(TouchResult(error_mm, None, size, cpu_ms=spent_ms))
        began_s = time.process_time()
    return found


def follow_push(trial: PushedTrial, motion: str, proposal: Proposal) -> dict[str, Any]:
    """A filter's median error [mm] during a push, and whether its estimate misleads at the end;
    `motion` is the filter's, or TOLD: it knows the trial's ground."""
    model, is_told = trial.model, motion == TOLD
    config = methods.SHIPPED.config(OWN_SEEDS + trial.seed, "push" if is_told else motion)
    estimator = Estimator(model, proposal, config)
    if is_told and isinstance(estimator.rule, Mixture):
        estimator.rule.push = by_ground(trial.ground)
    errors = []
    for moment in trial:
        estimate = estimator.on_scan(moment.activation, moment.sensor)
        if moment.touch == pushing.TOUCHES and moment.activation.z.any():
            errors.append(1e3 * add_m(model.scene, estimate.map, moment.truth)[1])
    misleading = is_misleading(estimate.p, errors[-1], 1e3 * estimate.radius_m)
    return {"path_mm": float(np.median(errors)), "misleading": bool(misleading)}


def _error_mm(trial: Trial, model: ObservationModel, moment: TrialScan, pose: Poses) -> float:
    """Symmetric ADD [mm] of an estimate (3,). Where two objects of one kind are touched the nearer
    counts, as no reading tells which of them is meant."""
    if trial.model is not model:
        return math.nan
    truths = [moment.truth] if moment.twin is None else [moment.truth, moment.twin]
    return 1e3 * min(add_m(model.scene, pose, truth)[1] for truth in truths)
