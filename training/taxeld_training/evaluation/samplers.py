"""Samplers of the questions: trained once and kept, and held against the exact posterior."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from taxeld.layout import read as layouts
from taxeld.model.contacts import Proposal
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_sim import jobs
from taxeld_sim.answers.questions import Question
from taxeld_sim.answers.score import by_seeds
from taxeld_sim.jobs import Job
from taxeld_sim.trials.case import Case
from taxeld_sim.world.subjects import Subject, model_of
from taxeld_training.limits import quality
from taxeld_training.models import export, variants
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.models.variants import Variant

Row: TypeAlias = dict[str, Any]
Wanted: TypeAlias = tuple[Subject, tuple[str, ...], str]  # an object, a skin, a proposal
Run: TypeAlias = Callable[[Sequence[Job]], dict[str, Any]]  # results by job name

_DIFFUSION = variants.diffusion()
LEARNED: dict[str, Variant] = {  # proposals that are trained here
    "density": variants.density(64),
    "ddpm": replace(_DIFFUSION, network=replace(_DIFFUSION.network, steps=8)),
    "paper": variants.paper(),
}
RING = "cylinder:rows=5,columns={},radius_m=0.04,pitch_m=0.015"
DECIDES = (  # code that decides what samplers learn, and how far off they are
    "taxeld/config/tables.py",
    "taxeld/estimator/scans.py",
    "taxeld/model/*.py",
    "taxeld/proposals/*.py",
    "taxeld_sim/objects/*.py",
    "taxeld_training/limits/*.py",
    "taxeld_training/models/*.py",
)


def wanted(case: Case) -> list[Wanted]:
    """The samplers that the known objects of a case need, in their order."""
    return [(known, case.specs[:1], case.method.proposal) for known in case.known]


def files(each: Iterable[Wanted], effort: float, memory: Path, run: Run) -> dict[Wanted, str]:
    """Train the samplers that are learned and have no file in `memory` yet, with a share of their
    full training; → their files."""
    found: dict[Wanted, str] = {}
    todo: list[Job] = []
    for one in dict.fromkeys(each):
        subject, (skin,), name = one
        if name not in LEARNED:
            continue
        words = f"{name}, {subject.name} on {jobs.layout_name(skin)}"
        variant = variants.trained_with(LEARNED[name], effort)
        job = Job(words, train, (subject, skin, variant), code=jobs.code(DECIDES))
        path = memory.resolve() / f"{job.key}.onnx"
        if not path.is_file():
            jobs.forget(job, memory)
        todo.append(replace(job, beside=(str(path),)))
        found[one] = str(path)
    run(todo)
    return found


def train(subject: Subject, skin: str, variant: Variant, file: str) -> dict[str, float]:
    """Train a sampler for an object on a skin and keep it in `file`."""
    model, rng = model_of(subject, skin), np.random.default_rng(variant.training.seed)
    touches = simulate(model, variant.training.contacts, rng)
    sampler = variants.sampler_of(variants.fit(variant, model, IN_USE, touches))
    part = Path(file).with_suffix(".part")
    gap = export.export(sampler, len(model.layout), part, asdict(variant))
    part.replace(file)
    return {"differs": gap}


def rows(question: Question, memory: Path, run: Run) -> list[Row]:
    """How far proposals' draws are from the exact posterior: a row an object, ring and proposal."""
    grid = [
        (Subject(name), RING.format(n), n) for name in question.objects for n in question.columns
    ]
    each = [(of, (skin,), name) for of, skin, _ in grid for name in question.proposals]
    kept = files(each, question.effort, memory, run)
    todo = [
        Job(
            f"readings of {of.name} on {columns} columns",
            distances,
            (of, skin, question.proposals, question.readings),
            ([kept.get((of, (skin,), name), "") for name in question.proposals],),
            jobs.code(DECIDES),
        )
        for of, skin, columns in grid
    ]
    done = run(todo)
    return [
        {"of": {"object": of.name, "columns": str(columns), "proposal": name}, **figures}
        for (of, _, columns), job in zip(grid, todo, strict=True)
        for name, figures in done[job.name].items()
    ]


def distances(
    subject: Subject, skin: str, names: Sequence[str], readings: int, kept: Sequence[str]
) -> dict[str, Row]:
    """A job: of each proposal the mean energy distance of its draws to as many exact ones, its
    interval over the readings, and what a call costs; `floor` is what chance alone makes of it."""
    model, rng = model_of(subject, skin), np.random.default_rng(0)
    to = quality.reference(model, IN_USE, readings, rng)
    found = {}
    for name, file in zip(names, kept, strict=True):
        proposal: Proposal
        if name in ANALYTIC:
            proposal = ANALYTIC[name](model)
        else:
            path = Path(file)
            proposal = Sampler(path.read_bytes(), layouts.load(skin), LEARNED[name].kind, path)
        off = quality.distances(proposal, to, rng)
        found[name] = {
            "readings": len(off),
            "distance": round(float(off.mean()), 5),
            "ci": {"distance": by_seeds(np.mean, off, np.arange(len(off)), 5)},
            "floor": round(to.floor, 5),
            "ms": round(quality.cost_ms(proposal, to, rng), 3),
        }
    return found
