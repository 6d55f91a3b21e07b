"""Measurements of samplers on an object and a skin, against the exact posterior.

A `Measurement` names all that its rows depend on. Each group of samplers (analytic proposals, one
trained model, one rival) is a job of its own; the jobs share the exact posteriors through a file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.model.observation import Noise, ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.analytic import ANALYTIC, Table
from taxeld_training.limits import metrics, quality
from taxeld_training.limits.rivals import train_rival
from taxeld_training.models import variants
from taxeld_training.models.dataset import simulate
from taxeld_training.models.export import AnySampler, flops
from taxeld_training.models.variants import Variant
from taxeld_training.objects.setting import Setting

COLUMNS = (8, 16, 32, 64)  # of the paper's skins, 5 rows each
LARGE_TABLE = "table-1e5"  # what a table of ten times the contacts buys


@dataclass(frozen=True)
class Measurement(Setting):
    """A setting, and how thoroughly samplers are setting in it."""

    readings: int = 64  # with an exact posterior
    contacts: int = 1000  # for errors against the truth
    slow_contacts: int = 200  # the same, of samplers that take long
    bank: int = quality.BANK
    epochs: int | None = None  # of a rival; None: its own


class Tried(NamedTuple):
    """A sampler to be setting, as the rows name it."""

    proposal: str
    steps: int | None
    width: int | None
    flops: int | None
    sampler: Proposal


class Eager:
    """A trained model as a proposal run by torch, without an ONNX file."""

    def __init__(self, trained: AnySampler) -> None:
        self.name = trained.family
        self.trained = trained
        trained.eval()

    def propose(
        self, z: Floats, live: NDArray[np.bool_], n: int, rng: np.random.Generator
    ) -> Poses:
        noise = rng.standard_normal((self.trained.noise_steps, n, 4), dtype=np.float32)
        with torch.no_grad():
            four = self.trained(
                torch.from_numpy(z).float()[None],
                torch.from_numpy(live).float()[None],
                torch.from_numpy(noise),
            )
        x, y, c, s = four.double().numpy().T
        return np.column_stack([x, y, np.arctan2(s, c)])


def make_reference(setting: Measurement, path: str) -> dict[str, float]:
    """Write the exact posteriors to `path` for the other jobs; → figures about them."""
    rng = np.random.default_rng(setting.seed + 1)
    to = quality.reference(setting.model(), Noise(), setting.readings, rng, bank=setting.bank)
    quality.save(to, Path(path))
    return {"floor": to.floor, "error": to.error, "left_out": to.left_out, "ms": to.ms}


def measure(
    setting: Measurement, group: str, reference: str, variant: Variant | None
) -> list[dict[str, Any]]:
    """Rows of all samplers of a group: `analytic`, a rival of sbi, or a model by its variant."""
    model = setting.model()
    to = quality.load(Path(reference))
    rng = np.random.default_rng(setting.seed + 2)
    touches = simulate(model, setting.contacts, rng)
    z = Noise().draw(touches.activation.astype(np.float64), rng)
    rows = []
    for tried in samplers_of(setting, group, variant, model):
        slow = tried.sampler.name in ("npse", "fmpe") or (tried.steps or 0) > 50
        count = setting.slow_contacts if slow else setting.contacts
        live = np.ones(len(model.layout), dtype=bool)
        samples = [tried.sampler.propose(each, live, quality.SAMPLES, rng) for each in z[:count]]
        rows.append({
            **_named(setting, tried),
            **metrics.summary(model, z[:count], touches.pose[:count], samples, rng),
            "energy_distance": quality.distance(tried.sampler, to, rng),
            "energy_floor": to.floor,
        })  # fmt: skip
    if group == "analytic":
        exact = [draws[: quality.SAMPLES] for draws in to.exact]
        limit = Tried("exact", None, None, None, ANALYTIC["projection"](model))
        rows.append({
            **_named(setting, limit),
            **metrics.summary(model, np.array(to.z), np.array(to.truth), exact, rng),
            "energy_distance": to.floor,
            "energy_floor": to.floor,
        })  # fmt: skip
    return rows


def _named(setting: Measurement, tried: Tried) -> dict[str, Any]:
    return {
        "object": setting.object,
        "columns": setting.columns,
        "proposal": tried.proposal,
        "steps": tried.steps,
        "width": tried.width,
        "flops": tried.flops,
    }


def samplers_of(
    setting: Measurement, group: str, variant: Variant | None, model: ObservationModel
) -> Iterator[Tried]:
    """The samplers of a group, as `measure` has it, trained for `setting.updates`."""
    if group == "analytic":
        for name, make in ANALYTIC.items():
            yield Tried(name, None, None, None, make(model))
    elif group == LARGE_TABLE:
        yield Tried(group, None, None, None, Table(model, 100_000))
    elif variant is not None:
        variant = variants.trained_with(variant, setting.updates)
        rng = np.random.default_rng(setting.seed)
        touches = simulate(model, variant.training.contacts, rng)
        network = variants.fit(variant, model, Noise(), touches)
        for sampler in variants.samplers(variant, network).values():
            yield Tried(
                "paper" if group == "paper" else sampler.family,
                sampler.steps,
                variant.network.width,
                flops(sampler, quality.SAMPLES),
                Eager(sampler),
            )
    else:
        rival = train_rival(group, model, Noise(), seed=setting.seed, max_epochs=setting.epochs)
        yield Tried(group, None, None, None, rival)
