"""A filter run through a trial: its estimate after each touch, compared with the truth."""

import math
import time
from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.memory import Slack
from taxeld.estimator.news import EstimatorCounters, Intake, News
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import add_m
from taxeld_training.filters.identities import UNKNOWN
from taxeld_training.filters.methods import NOISE, Method, TouchResult
from taxeld_training.filters.trials import SCAN_S, TrialScan
from taxeld_training.limits.grid_filter import GridFilter

OWN_SEEDS = 2**31  # added to a trial's seed, so that a filter does not draw what its trial drew
SLACK = Slack(SensorPoseConfig().sigma_m, FilterConfig().nudge_m)  # the daemon's default


def estimator_of(known: Sequence[Known], method: Method, seed: int) -> Estimator:
    """The filter of a method that knows these objects, for the trial of a seed."""
    first, *more = known
    config = method.config(OWN_SEEDS + seed)
    return Estimator(first.model, first.proposal, config, more=more, beside=first.beside)


def follow(scans: Iterable[TrialScan], estimator: Estimator, true: int = 0) -> list[TouchResult]:
    """The result of each touch; `true`: the number of the touched object, or UNKNOWN."""
    found = []
    for _, moments in groupby(scans, key=lambda moment: moment.touch):
        all_s, idle_s = list[float](), list[float]()
        for moment in moments:
            thoughts, began_s = estimator.counters.thoughts, time.process_time()
            now = estimator.on_scan(moment.activation, moment.sensor, moment.link)
            all_s.append(time.process_time() - began_s)
            if estimator.used is None and estimator.counters.thoughts == thoughts:
                idle_s.append(all_s[-1])
        is_right = now.object == true != UNKNOWN
        model = estimator.known[now.object].model
        found.append(
            TouchResult(
                error_mm(model, moment, now.map) if is_right else math.nan,
                now.status,
                now.particles,
                now.p,
                now.radius_m,
                now.hypotheses,
                1e3 * math.fsum(all_s),
                1e3 * float(np.mean(idle_s or math.nan)) / SCAN_S,
                now.object,
                now.objects,
            )
        )
    return found


def follow_grid(
    scans: Iterable[TrialScan], model: ObservationModel, touches: Sequence[int], true: int = 0
) -> list[TouchResult]:
    """The result of each touch by the grid filter, which learns from what the estimator learns
    from. It looks at its belief after some touches, or after each. The trial's own processor time,
    little beside the grid's, is counted with it."""
    grid = GridFilter(model, NOISE, SLACK)
    intake, news = Intake(model, EstimatorCounters()), News(model.layout.radius_m)
    found, began_s = [], time.process_time()
    for touch, moments in groupby(scans, key=lambda moment: moment.touch):
        for moment in moments:
            scan = intake.observation(moment.activation, moment.sensor)
            new = None
            if scan is not None and scan.live.any():
                new = news.on_scan(moment.activation.t, scan)
            if new is not None:
                grid.update(new, touched=new.is_contact, contact=news.contacts)
        size = len(grid) if not touches or touch + 1 in touches else 0
        is_told = size and true != UNKNOWN
        off_mm = error_mm(model, moment, grid.estimate()[0]) if is_told else math.nan
        spent_ms = 1e3 * (time.process_time() - began_s)
        found.append(TouchResult(off_mm, None, size, cpu_ms=spent_ms))
        began_s = time.process_time()
    return found


def error_mm(model: ObservationModel, moment: TrialScan, pose: Poses) -> float:
    """Symmetric ADD [mm] of an estimate (3,). Where two objects of one kind are touched the nearer
    counts, as no reading tells which of them is meant."""
    truths = [moment.truth] if moment.twin is None else [moment.truth, moment.twin]
    return 1e3 * min(add_m(model.scene, pose, truth)[1] for truth in truths)
