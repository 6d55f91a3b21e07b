"""The samplers of a bundle, trained and exported: a density, and where it is asked for the
diffusion, a baseline."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from taxeld.errors import SetupError
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import Table
from taxeld_training.models import export, variants
from taxeld_training.models.dataset import IN_USE, LEARNED, simulate
from taxeld_training.models.variants import Variant

CONTACTS_OF = 30_000, 300_000  # simulated for the least training, and for a full one
MOST_EFFORT = 100.0

CONTACTS, TRAINING = "contacts", "training"
STAGES = CONTACTS, TRAINING


def of(effort: float, *, ddpm: bool = False) -> list[Variant]:
    """The models that a build trains, with a share of their full training, the one that the daemon
    may choose first. Raises SetupError."""
    if not 0.0 < effort <= MOST_EFFORT:
        raise SetupError(f"--effort: must be over 0 and at most {MOST_EFFORT:g}, not {effort:g}")
    least, full = CONTACTS_OF
    contacts = round(max(least, min(effort, 1.0) * full))
    wanted = [variants.density(64), *([variants.diffusion()] if ddpm else [])]
    return [variants.trained_with(one, effort, contacts) for one in wanted]


def make(
    model: ObservationModel,
    given: Sequence[Variant],
    folder: Path,
    progress: Callable[[str, float], None],
) -> dict[str, Any]:
    """Train the models and export them into `folder`; → the part of bundle.json about samplers.
    `progress` is told each of `STAGES`, and the share of it that is done."""
    most = max(variant.training.contacts for variant in given)
    touches = simulate(model, most, np.random.default_rng(0), partial(progress, CONTACTS))
    torch.set_num_threads(1)  # more would wait for one another
    samplers = []
    for number, variant in enumerate(given):

        def tell(share: float, done: int = number) -> None:
            progress(TRAINING, (done + share) / len(given))

        network = variants.fit(variant, model, IN_USE, touches, tell)
        sampler = variants.sampler_of(network)
        size = sampler.steps if variant.family == "diffusion" else network.config.width
        path = folder / f"{sampler.family}-{size}.onnx"
        metadata = asdict(variant) | {
            "noise": LEARNED,
            "layout": model.layout.digest,
            "normalisation": {k: getattr(network, k).tolist() for k in ("mean", "scale")},
        }
        export.export(sampler, len(model.layout), path, metadata)
        samplers.append({"name": path.stem, "kind": variant.kind, "file": path.name})
    return {"noise": LEARNED, "samplers": samplers, "auto": [Table.name, samplers[0]["name"]]}
