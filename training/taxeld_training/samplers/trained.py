"""Proposals of the experiments: analytic ones, a density, shipped or trained once, and the paper's
own diffusion.

Models that experiments train are kept as files beside the results, so a filter follows with the
model that the samplers' rows have measured.
"""

import time
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.layout import read as layouts
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_hil.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, with_file
from taxeld_training.models import export, variants
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.models.variants import MODELS, Variant
from taxeld_training.objects import DEPTH_MAX_M
from taxeld_training.objects.setting import Setting

DENSITY, PAPER = "density", "paper"
LEARNED = {DENSITY: MODELS["density-64"], PAPER: MODELS["paper"]}
SHIPPED_BUNDLES = ("box", "mug")

Wanted: TypeAlias = tuple[Setting, str]  # a proposal by name, for an object on a skin


@lru_cache(maxsize=8)
def shipped(setting: Setting) -> bundle.Bundle | None:
    """The bundle of the setting's object and skin, if one is shipped."""
    if not setting.is_as_shipped:
        return None
    layout = layouts.load(setting.skin)
    for name in SHIPPED_BUNDLES:
        try:
            found = bundle.load(name, layout, DEPTH_MAX_M)
        except SetupError:  # it is for another skin
            continue
        if found.manifest.object == setting.object:
            return found
    return None


@lru_cache(maxsize=32)
def model_of(setting: Setting) -> ObservationModel:
    """The model of a setting, the same instance each time: models are compared by identity."""
    found = shipped(setting)
    return setting.model() if found is None else found.model


def is_learned(name: str, setting: Setting) -> bool:
    """Whether a proposal comes from a file that an experiment trains: none ships it."""
    return name in LEARNED and not (name == DENSITY and shipped(setting) is not None)


def proposal_of(name: str, setting: Setting, file: str) -> Proposal:
    """By name; a learned one that is not shipped is taken from `file`."""
    model = model_of(setting)
    if name in ANALYTIC:
        return ANALYTIC[name](model)
    if is_learned(name, setting):
        return Sampler(Path(file).read_bytes(), model.layout, LEARNED[name].kind, Path(file))
    found = shipped(setting)
    if found is None:
        raise SetupError(f"{setting.object}: no bundle of it is shipped for this skin")
    return found.proposal(name)


@lru_cache(maxsize=32)
def known_of(setting: Setting, name: str, file: str) -> Known:
    """The object of a setting with a proposal, as `proposal_of` has it."""
    return Known(model_of(setting), proposal_of(name, setting, file))


def files(wanted: Iterable[Wanted], options: Options) -> dict[Wanted, str]:
    """Train the proposals that are learned and have no file yet. → The file of each, "" for one
    that needs none; a proposal that time ran out for is left out."""
    ordered = sorted(set(wanted), key=lambda each: (each[0].name, each[1]))
    todo = {
        (setting, name): training(setting, name, options.memory)
        for setting, name in ordered
        if is_learned(name, setting)
    }
    done = run_jobs(list(todo.values()), options, options.memory) if todo else {}
    found = {each: job.beside[0] for each, job in todo.items() if done[job.name]}
    return found | dict.fromkeys((each for each in ordered if each not in todo), "")


def training(setting: Setting, name: str, memory: Path) -> Job:
    """The job that trains a proposal; `beside` its arguments is the file that it makes."""
    job = Job(f"{name}-{setting.name}", train, (setting, LEARNED[name]))
    return with_file(job, memory, ".onnx")


def train(setting: Setting, given: Variant, file: str) -> dict[str, float]:
    """Train a model for the setting and keep its sampler in `file`."""
    start = time.monotonic()
    model = model_of(setting)
    variant = variants.trained_with(given, setting.updates, seed=setting.seed)
    touches = simulate(model, variant.training.contacts, np.random.default_rng(setting.seed))
    network = variants.fit(variant, model, IN_USE, touches)
    sampler = variants.sampler_of(network)
    part = Path(file).with_suffix(".part")
    gap = export.export(sampler, len(model.layout), part, variant.describe())
    part.replace(file)
    return {"seconds": time.monotonic() - start, "differs": gap}
