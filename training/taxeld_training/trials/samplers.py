"""Samplers of the questions: trained once and kept."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from taxeld_hil import jobs
from taxeld_hil.jobs import Job
from taxeld_hil.trials.case import Case
from taxeld_hil.world.subjects import Subject, model_of
from taxeld_training.models import export, variants
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.models.variants import Variant

Wanted: TypeAlias = tuple[Subject, tuple[str, ...], str]  # an object, a skin, a proposal
Run: TypeAlias = Callable[[Sequence[Job]], dict[str, Any]]  # results by job name

_DIFFUSION = variants.diffusion()
LEARNED: dict[str, Variant] = {  # proposals that are trained here
    "density": variants.density(64),
    "ddpm": replace(_DIFFUSION, network=replace(_DIFFUSION.network, steps=8)),
    "paper": variants.paper(),
}


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
        job = Job(words, train, (subject, skin, variants.trained_with(LEARNED[name], effort)))
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
    sampler = variants.sampler_of(variants.fit([variant], model, IN_USE, touches)[0])
    part = Path(file).with_suffix(".part")
    gap = export.export(sampler, len(model.layout), part, asdict(variant))
    part.replace(file)
    return {"differs": gap}
