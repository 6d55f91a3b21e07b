"""A filter run through a trial: its estimate after each touch, compared with the truth."""

import ast
import hashlib
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.news import News
from taxeld.model.observation import Noise, Observation, ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.model.symmetry import SILENT_MM, add_m
from taxeld_training.filters import pusher
from taxeld_training.filters.pusher import PushedTrial
from taxeld_training.filters.trials import Moment, Trial
from taxeld_training.jobs.rows import GRID, SUCCESS_MM
from taxeld_training.limits.grid_filter import GridFilter

OWN_SEEDS = 2**31  # added to a trial's seed: a filter must not draw what its trial drew

# what decides a filter's estimates in a trial; where it has particles, their samples as well
ROOMS = ("taxeld.model", "taxeld.estimator", "taxeld_training.filters")
SAMPLES = ("taxeld.proposals",)


@dataclass(frozen=True)
class Method:
    """A filter by its parts."""

    proposal: str  # GRID: the limit, which has neither injection nor particles
    injection: str = ""
    particles: int = 0
    particles_max: int = 0  # 0: no more than that

    @property
    def name(self) -> str:
        size = f"{self.particles}{f'..{self.particles_max}' if self.particles_max else ''}"
        return "-".join(part for part in (self.proposal, self.injection, size) if part != "0")

    def config(self, seed: int) -> FilterConfig:
        return FilterConfig(
            particles=self.particles,
            particles_max=self.particles_max or self.particles,
            injected=self.particles // 2,
            injection=self.injection,
            noise_sigma=Noise().sigma,  # with which trials are read
            seed=seed,
        )


class TouchResult(NamedTuple):
    """A filter's estimate after a touch; errors are nan where there is none, and where the filter
    assumes another object than the one touched."""

    map_mm: float
    mean_mm: float
    status: Status | None  # None: the grid filter has none
    particles: int

    @property
    def succeeded(self) -> bool:
        return self.map_mm < SUCCESS_MM

    @property
    def converged(self) -> bool:
        return self.status is Status.CONVERGED

    @property
    def failed_silently(self) -> bool:
        return self.converged and not self.map_mm <= SILENT_MM


def follow(
    trial: Trial, method: Method, model: ObservationModel, proposal: Proposal | None
) -> list[TouchResult]:
    """The result of each touch, of a method that assumes the object of `model`."""
    if proposal is None:
        return _follow_grid(trial, model)
    estimator = Estimator(model, proposal, method.config(OWN_SEEDS + trial.seed))
    found = []
    for _, moments in groupby(trial, key=lambda moment: moment.touch):
        for moment in moments:
            estimate = estimator.on_scan(moment.activation, moment.sensor)
        errors = _errors(trial, model, moment, estimate.map, estimate.mean)
        found.append(TouchResult(*errors, estimate.status, estimate.particles))
    return found


def _follow_grid(trial: Trial, model: ObservationModel) -> list[TouchResult]:
    """The same of the grid filter, which learns from the scans that the estimator learns from."""
    grid = GridFilter(model, Noise())
    news = News(model.layout.radius_m)
    found = []
    for _, moments in groupby(trial, key=lambda moment: moment.touch):
        for moment in moments:
            read = moment.activation
            scan = Observation(moment.sensor, read.z, read.live, read.floor)
            new = news.on_scan(read.t, scan)
            if new is not None:
                grid.update(new, touched=new.is_contact)
        errors = (math.nan, math.nan)
        if len(grid):
            errors = _errors(trial, model, moment, *grid.estimate())
        found.append(TouchResult(*errors, None, len(grid)))
    return found


def follow_push(trial: PushedTrial, motion: str, proposal: Proposal) -> dict[str, Any]:
    """How far the object was pushed, and a filter's errors [mm] on the way and at the end."""
    model = trial.model
    config = FilterConfig(motion=motion, noise_sigma=Noise().sigma, seed=OWN_SEEDS + trial.seed)
    estimator = Estimator(model, proposal, config)
    errors = []
    for moment in trial:
        estimate = estimator.on_scan(moment.activation, moment.sensor)
        if moment.touch < pusher.TOUCHES:
            start = moment.truth
        elif moment.activation.z.any():
            errors.append(1e3 * add_m(model.scene, estimate.map, moment.truth)[1])
    moved_m, turned = pusher.travel(start, moment.truth)
    return {
        "moved_mm": 1e3 * moved_m,
        "turned_deg": math.degrees(turned),
        "path_mm": float(np.median(errors)),
        "end_mm": errors[-1],
        "silent": estimate.status is Status.CONVERGED and errors[-1] > SILENT_MM,
    }


def _errors(
    trial: Trial, model: ObservationModel, moment: Moment, peak: Poses, mean: Poses
) -> tuple[float, float]:
    """Symmetric ADD [mm] of the heaviest mode and of the mean. Where two objects of one kind are
    touched the nearer counts, as no reading tells which of them is meant."""
    if trial.model is not model:
        return math.nan, math.nan
    truths = [moment.truth] if moment.twin is None else [moment.truth, moment.twin]
    off = [min(add_m(model.scene, pose, truth)[1] for truth in truths) for pose in (peak, mean)]
    return off[0] * 1e3, off[1] * 1e3


@cache
def code(proposal: str) -> str:
    """Hash of the code that decides a trial's results with such a proposal, so that other code is
    another job. Docstrings, comments and layout do not count."""
    rooms = ROOMS if proposal == GRID else ROOMS + SAMPLES
    folders = [Path(str(resources.files(room))) for room in rooms]
    files = [file for folder in folders for file in sorted(folder.glob("*.py"))]
    if proposal == GRID:
        files += sorted(Path(str(resources.files("taxeld_training.limits"))).glob("grid_*.py"))
    digest = hashlib.sha256(repr(FilterConfig()).encode())
    for file in files:
        digest.update(_bare(file.read_text(encoding="utf-8")).encode())
    return digest.hexdigest()[:12]


def _bare(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)
