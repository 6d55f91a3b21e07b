"""A trial: the world's scans and poses straight into a pipeline, and its estimate after each touch.

A touch is noted `SEEN_S` after it ends, by when the filter has learned from it.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Estimate
from taxeld.model import se2
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome, Pipeline
from taxeld.proposals.samples import Samples
from taxeld_protocol.decoder import Scan
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.guides import BeliefGuide
from taxeld_sim.world.plan import PLANNED, PUSH_M
from taxeld_sim.world.subjects import model_of
from taxeld_sim.world.world import World, planned_world

TICK_S = 0.01  # between two poses
SCAN_S = 0.05
POSE_AGE_S = 0.004  # age of a pose as it comes: scans fall between poses
SEEN_S = 0.4


class Touch(NamedTuple):
    """An estimate after a touch."""

    named: int  # number of the known object that it is of
    error_mm: float  # symmetric ADD, to the nearer of two of a kind; nan: another object is touched
    p: float  # 0 where the estimate is not valid: it claims nothing
    radius_mm: float
    objects: tuple[float, ...]  # probabilities of the known objects
    other: float  # probability of none of them
    moved: float  # probability that the object has moved
    status: str
    particles: int
    ms: float  # processor time of the filter for all scans of the touch
    idle_ms: float  # and for a second of scans that tell nothing
    guide_ms: float  # processor time of the advice before the touch
    path_mm: float = math.nan  # median error over a push


class Direct:
    """Drives a world and a pipeline together, scan by scan."""

    def __init__(self, world: World, pipeline: Pipeline, first: int = 0) -> None:
        """`first`: ticks until the first scan."""
        self.world, self.pipeline = world, pipeline
        self._posed, self._next = 0, first  # ticks of the next pose and the next scan

    @property
    def t(self) -> float:
        """Scenario time of the next scan."""
        return self._next * TICK_S

    def outcomes(self, until_s: float) -> Iterator[Outcome]:
        """Of all scans before a scenario time."""
        world = self.world
        while (t := self.t) < until_s:
            sent = np.arange(self._posed, self._next + 1, dtype=np.float64) * TICK_S - POSE_AGE_S
            self._posed, self._next = self._next + 1, self._next + round(SCAN_S / TICK_S)
            came = []
            for link, stage in enumerate(self.pipeline.stages):
                rows = np.column_stack([sent, world.stated(sent, link)])
                for at, x, y, yaw in rows.tolist():
                    stage.poses.add(at, x, y, yaw)
                counts = tuple(world.step(t, link).counts)
                came.append(Scan(t, 1, counts, world.modules[link], 1, link=link))
            yield from self.pipeline.advance(came, t)


def world_of(case: Case, seed: int) -> World:
    """The world of a trial. Raises SetupError as `planned_world`."""
    return planned_world(case.subject, case.specs, case.conditions, case.guide, case.touches, seed)


def play(case: Case, seed: int) -> list[Touch]:
    """The estimate after each touch of the trial of a seed.

    Raises:
        SetupError: an object, a layout or a sampler cannot be found, read or used.
    """
    world, config = world_of(case, seed), case.config(seed)
    models = [model_of(each, *case.specs) for each in case.known]
    samples = Samples(case.proposals(), time.process_time_ns)
    layouts = [link.layout for link in models[0].links]
    calibrations = [
        skin.calibration(link.depth_max_m) if case.conditions.calibrated else None
        for skin, link in zip(world.skins, world.links, strict=True)
    ]
    pipeline = Pipeline(config, layouts, models, samples, calibration=calibrations)
    direct = Direct(world, pipeline)
    guide = None if case.guide in PLANNED else BeliefGuide(case.guide, pipeline.estimator, seed)
    found, true = [], _number(case)
    for touch in range(case.touches):
        guide_ms = 0.0
        if guide is not None:
            guide_ms = guide.lead(world, direct.t)
        note_s = world.touched_s()[touch, 1] + SEEN_S
        if guide is not None:  # at rest, before it is told where to go on
            note_s = max(note_s, world.duration_s + SCAN_S)
        found.append(_noted(direct, note_s, true, guide_ms))
    if case.guide == "push":
        world.push()
        found.append(_noted(direct, world.duration_s, true, 0.0))
    return found


def _number(case: Case) -> int:
    """The number of the touched object among the known; -1: it is none of them."""
    known = [replace(each, sampler="") for each in case.known]
    touched = replace(case.subject, sampler="")
    return known.index(touched) if touched in known else -1


def _noted(direct: Direct, until_s: float, true: int, guide_ms: float) -> Touch:
    """The estimate at a scenario time, or once the object was pushed far enough; `true`: number of
    the object that is touched."""
    world, pipeline = direct.world, direct.pipeline
    estimator, freshness = pipeline.estimator, pipeline.freshness
    scene, thoughts = estimator.known[true].model.scene, estimator.counters.thoughts
    all_ns, idle_ns, path_mm = 0, list[int](), list[float]()
    for outcome in direct.outcomes(until_s):
        spent_ns = outcome.filter_ns + outcome.propose_ns
        all_ns += spent_ns
        is_idle = outcome.is_used and estimator.used is None
        if is_idle and estimator.counters.thoughts == thoughts:
            idle_ns.append(spent_ns)
        thoughts = estimator.counters.thoughts
        if world.pushed_m and pipeline.is_touched:
            path_mm.append(_error_mm(world, scene, pipeline.estimate.map, direct.t))
        if world.pushed_m >= PUSH_M:
            break
    now = pipeline.estimate
    error_mm = _error_mm(world, scene, now.map, until_s) if now.object == true else math.nan
    idle_ms = 1e-6 * float(np.mean(idle_ns)) / SCAN_S if idle_ns else math.nan
    p = now.p if freshness.why(now) is Why.VALID else 0.0
    return touch_of(now, p, error_mm, 1e-6 * all_ns, idle_ms, guide_ms, path_mm)


def touch_of(
    now: Estimate,
    p: float,
    error_mm: float,
    ms: float = math.nan,
    idle_ms: float = math.nan,
    guide_ms: float = 0.0,
    path_mm: Sequence[float] = (),
) -> Touch:
    """An estimate after a touch, with its p and error; `path_mm`: errors over a push."""
    return Touch(
        named=now.object,
        error_mm=round(error_mm, 4),
        p=round(p, 6),
        radius_mm=round(1e3 * now.radius_m, 4),
        objects=tuple(float(f"{share:.6g}") for share in now.objects),
        other=round(now.hypotheses.other, 6),
        moved=round(now.hypotheses.moved, 6),
        status=now.status.name.lower(),
        particles=now.particles,
        ms=round(ms, 4),
        idle_ms=round(idle_ms, 4),
        guide_ms=round(guide_ms, 4),
        path_mm=round(float(np.median(path_mm or math.nan)), 4),
    )


def _error_mm(world: World, scene: Scene, pose: Poses, t: float) -> float:
    """Symmetric ADD [mm] of an estimate (3,) at scenario time t. Where two objects of one kind are
    touched the nearer counts, as no reading tells which of them is meant."""
    truth = world.truth_at(t)
    truths = [truth] if world.twin is None else [truth, se2.compose(truth, world.twin)]
    return 1e3 * min(add_m(scene, pose, each)[1] for each in truths)
