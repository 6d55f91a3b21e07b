"""Measurements of samplers on an object and a skin, against the exact posterior.

Samplers come in groups: the analytic proposals, or one trained model. Each group is a job of its
own; the jobs share the exact posteriors through a file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from taxeld.arrays import Bools, Floats, Poses
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.analytic import ANALYTIC, Table
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.jobs.statistics import of_mean, rounded
from taxeld_training.limits import metrics, quality
from taxeld_training.models import variants
from taxeld_training.models.dataset import IN_USE, read, simulate
from taxeld_training.models.export import AnySampler, flops
from taxeld_training.models.variants import MODELS
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

ALL_ANALYTIC, LARGE_TABLE = (
    "analytic",
    "table-1e5",
)  # the second is a table of ten times the contacts
GROUPS = (ALL_ANALYTIC, LARGE_TABLE, *MODELS)
LEARNED = {  # groups of models that are trained once for all experiments
    "density-64": trained.DENSITY,
    "paper": trained.PAPER,
}
MANY_STEPS = 50  # a sampler of more steps is measured on fewer contacts


@dataclass(frozen=True)
class Measurement(Setting):
    """A setting, and how thoroughly samplers are measured in it."""

    readings: int = 64  # readings with an exact posterior
    contacts: int = 1000  # contacts for errors against the truth
    slow_contacts: int = 200  # contacts for samplers that take long
    bank: int = quality.BANK

    @property
    def place(self) -> Setting:
        """The setting alone."""
        return Setting(self.object, self.skin, self.columns, self.updates, self.seed)


class Tried(NamedTuple):
    """A sampler to be measured, as the rows name it."""

    proposal: str
    sampler: Proposal
    steps: int | None = None
    width: int | None = None
    flops: int | None = None


class Eager:
    """A trained model as a proposal run by torch, without an ONNX file."""

    def __init__(self, trained: AnySampler) -> None:
        self.name = trained.family
        self._trained = trained.eval()

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """(n, 3) poses for a reading z (M,) of the taxels that are `live` (M,)."""
        noise = rng.standard_normal((self._trained.noise_steps, n, 4), dtype=np.float32)
        with torch.no_grad():
            four = self._trained(
                torch.from_numpy(z).float()[None],
                torch.from_numpy(live).float()[None],
                torch.from_numpy(noise),
            )
        x, y, c, s = four.double().numpy().T
        return np.column_stack([x, y, np.arctan2(s, c)])


def make_reference(setting: Measurement, path: str) -> dict[str, float]:
    """Write the exact posteriors to `path` for the other jobs; → figures about them."""
    rng = np.random.default_rng(setting.seed + 1)
    to = quality.reference(setting.model(), IN_USE, setting.readings, rng, bank=setting.bank)
    quality.save(to, Path(path))
    return {"floor": to.floor, "error": to.error, "left_out": to.left_out, "ms": to.ms}


def measure(
    setting: Measurement, group: str, reference: str, file: str | None = None
) -> list[dict[str, Any]]:
    """Rows of all samplers of a group. A model is trained here, or taken from a `file`, "" for one
    that ships."""
    model = setting.model()
    to = quality.load(Path(reference))
    rng = np.random.default_rng(setting.seed + 2)
    seen = read(model, IN_USE, setting.contacts, rng)
    rows = []
    for tried in _samplers(setting, group, model, file):
        is_slow = (tried.steps or 0) > MANY_STEPS
        count = setting.slow_contacts if is_slow else setting.contacts
        some = zip(seen.z[:count], seen.live[:count], strict=True)
        samples = [tried.sampler.propose(z, live, quality.SAMPLES, rng) for z, live in some]
        distances = quality.distances(tried.sampler, to, rng)
        errors = metrics.summary(model.scene, seen.pose[:count], samples, rng)
        rows.append(_row(setting, tried, errors, distances, to, rng))
    if group == ALL_ANALYTIC:
        limit = Tried(EXACT, ANALYTIC["projection"](model))
        exact = list(to.exact[:, : quality.SAMPLES])
        errors = metrics.summary(model.scene, to.truth, exact, rng)
        rows.append(_row(setting, limit, errors, to.floors, to, rng))
    return rows


def _row(
    setting: Setting,
    tried: Tried,
    errors: dict[str, Any],
    distances: Floats,
    to: quality.Reference,
    rng: np.random.Generator,
) -> dict[str, Any]:
    return {
        "object": setting.object,
        "columns": setting.columns,
        "proposal": tried.proposal,
        "steps": tried.steps,
        "width": tried.width,
        "flops": tried.flops,
        **errors,
        "energy_distance": float(distances.mean()),
        "energy_distance_ci": rounded(of_mean([distances], rng), 5),
        "energy_floor": to.floor,
        "left_out": to.left_out,
        DISTANCES: [round(value, 5) for value in distances.tolist()],
    }


def _samplers(
    setting: Measurement, group: str, model: ObservationModel, file: str | None
) -> Iterator[Tried]:
    if group not in MODELS:
        yield from untrained(group, model)
    elif file is not None:
        network = variants.untrained(MODELS[group], model)
        (known,) = variants.samplers(MODELS[group], network).values()
        yield learned(group, known, trained.proposal_of(LEARNED[group], setting.place, file))
    else:
        variant = variants.trained_with(MODELS[group], setting.updates)
        rng = np.random.default_rng(setting.seed)
        touches = simulate(model, variant.training.contacts, rng)
        network = variants.fit(variant, model, IN_USE, touches)
        for sampler in variants.samplers(variant, network).values():
            yield learned(group, sampler, Eager(sampler))


def untrained(group: str, model: ObservationModel) -> Iterator[Tried]:
    """The samplers of a group that learns nothing."""
    if group == LARGE_TABLE:
        yield Tried(group, Table(model, 100_000))
    else:
        for name, make in ANALYTIC.items():
            yield Tried(name, make(model))


def learned(group: str, known: AnySampler, sampler: Proposal) -> Tried:
    """`sampler` of a model's group, whose steps and sizes `known` has."""
    name = "paper" if group == "paper" else known.family
    work = flops(known, quality.SAMPLES)
    return Tried(name, sampler, known.steps, MODELS[group].network.width, work)
