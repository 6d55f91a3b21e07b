"""A filter led through a trial: what it says after each touch, and whether that is so."""

import ast
import hashlib
import math
from dataclasses import dataclass
from functools import cache
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import taxeld
from taxeld.config import FilterConfig
from taxeld.estimate import Status
from taxeld.estimator import Estimator
from taxeld.memory import Felt
from taxeld.news import News
from taxeld.observation import Noise, ObservationModel
from taxeld.proposals import Proposal
from taxeld.se2 import Poses
from taxeld.symmetry import add_m
from taxeld_training.grid_filter import GridFilter
from taxeld_training.trials import Moment, Trial

SUCCESS_MM = 10.0  # symmetric ADD of the heaviest mode
SILENT_MM = 20.0  # a converged estimate that is off by more has failed in silence
GRID = "grid"
OWN_SEEDS = 2**31  # a filter must not draw what its trial drew
DECIDES = {  # modules that decide what a filter says in a trial
    "daemon": "contacts estimate memory news observation prior scene se2 symmetry",
    "particles": "config consistency endpoints estimator filter injection mixture_rule paper_rule "
    "poses proposals push rule rules sampler stuck",
    "training": "conditions follow trials",
}


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


class Outcome(NamedTuple):
    """After a touch; errors are nan where there is no estimate, or the truth is another object."""

    map_mm: float
    mean_mm: float
    status: Status | None  # None of a filter that has none
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
) -> list[Outcome]:
    """What a method that takes the object for `model` says at the end of each touch."""
    if proposal is None:
        return _by_the_grid(trial, model)
    estimator = Estimator(model, proposal, method.config(OWN_SEEDS + trial.seed))
    found = []
    for _, scans in groupby(trial, key=lambda moment: moment.touch):
        for scan in scans:
            said = estimator.on_scan(scan.activation, scan.sensor)
        errors = _errors(trial, model, scan, said.map, said.mean)
        found.append(Outcome(*errors, said.status, said.particles))
    return found


def _by_the_grid(trial: Trial, model: ObservationModel) -> list[Outcome]:
    """The same of the grid filter, on the scans that the estimator learns from."""
    grid = GridFilter(model, Noise())
    news = News(model.layout.radius_m)
    found = []
    for _, scans in groupby(trial, key=lambda moment: moment.touch):
        for scan in scans:
            felt = Felt(scan.sensor, scan.activation.z, scan.activation.live)
            told = news.on_scan(scan.activation.t, felt)
            if told is not None:
                grid.update(told.sensor, told.z, told.live, touched=told.touch)
        errors = (math.nan, math.nan)
        if len(grid):
            errors = _errors(trial, model, scan, *grid.estimate())
        found.append(Outcome(*errors, None, len(grid)))
    return found


def _errors(
    trial: Trial, model: ObservationModel, moment: Moment, peak: Poses, mean: Poses
) -> tuple[float, float]:
    """Of the heaviest mode and the mean [mm]. Of two such objects touched the nearer counts:
    nothing tells which of them is meant."""
    if trial.model is not model:
        return math.nan, math.nan
    truths = [moment.truth] if moment.twin is None else [moment.truth, moment.twin]
    off = [min(add_m(model.scene, said, truth)[1] for truth in truths) for said in (peak, mean)]
    return off[0] * 1e3, off[1] * 1e3


@cache
def code(proposal: str) -> str:
    """Names the code that decides what a filter of such a proposal does in a trial: other code is
    another job. Comments and layout are not code."""
    daemon, training = Path(taxeld.__file__).parent, Path(__file__).parent
    files = [daemon / name for name in DECIDES["daemon"].split()]
    files += [training / name for name in DECIDES["training"].split()]
    if proposal == GRID:
        files.append(training / "grid_filter")
    else:
        files += [daemon / name for name in DECIDES["particles"].split()]
    digest = hashlib.sha256()
    for file in files:
        digest.update(_bare(file.with_suffix(".py").read_text(encoding="utf-8")).encode())
    return digest.hexdigest()[:12]


def _bare(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(tree)
