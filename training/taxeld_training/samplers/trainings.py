"""Models that experiments train once, kept as files beside the results.

What a filter follows with is so what the samplers' rows have measured.
"""

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from taxeld_hil.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, with_file
from taxeld_training.models import export, variants
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.models.variants import Variant
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

Wanted: TypeAlias = tuple[Setting, str]  # a proposal by name, for an object on a skin


def files(wanted: Iterable[Wanted], options: Options) -> dict[Wanted, str]:
    """Train what is to be learned and is not yet; → the file of each, "" of one that needs
    none, and nothing of one that time ran out for."""
    ordered = sorted(set(wanted), key=lambda each: (each[0].name, each[1]))
    learned = [each for each in ordered if trained.is_learned(each[1], each[0])]
    todo = trainings(learned, options.memory)
    done = run_jobs(list(todo.values()), options) if todo else {}
    found = {each: job.beside[0] for each, job in todo.items() if done[job.name]}
    return found | dict.fromkeys((each for each in ordered if each not in learned), "")


def trainings(wanted: Iterable[Wanted], memory: Path) -> dict[Wanted, Job]:
    """A job for each learned proposal; `beside` its arguments is the file it makes."""
    return {
        (setting, name): with_file(
            Job(f"{name}-{setting.name}", train, (setting, trained.LEARNED[name])), memory, ".onnx"
        )
        for setting, name in wanted
    }


def train(setting: Setting, given: Variant, file: str) -> dict[str, float]:
    """Train a model for the setting and keep its sampler in `file`."""
    start = time.monotonic()
    model = trained.model_of(setting)
    variant = variants.trained_with(given, setting.updates, seed=setting.seed)
    touches = simulate(model, variant.training.contacts, np.random.default_rng(setting.seed))
    network = variants.fit(variant, model, IN_USE, touches)
    (sampler,) = variants.samplers(variant, network).values()
    part = Path(file).with_suffix(".part")
    gap = export.export(sampler, len(model.layout), part, variant.describe())
    part.replace(file)
    return {"seconds": time.monotonic() - start, "differs": gap}
