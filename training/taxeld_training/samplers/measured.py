"""Measurements of samplers on an object and a skin, against the exact posterior.

Samplers come in groups: the analytic proposals, or one trained model. Each group is a job of its
own; the jobs share the exact posteriors through a file, and models are trained before.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Floats
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.jobs.statistics import of_mean, rounded
from taxeld_training.limits import metrics, quality
from taxeld_training.models import variants
from taxeld_training.models.dataset import IN_USE, read
from taxeld_training.models.export import flops
from taxeld_training.models.variants import MODELS
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

ALL_ANALYTIC = "analytic"
LEARNED = {  # groups of trained models
    "density-64": trained.DENSITY,
    "paper": trained.PAPER,
}
GROUPS = (ALL_ANALYTIC, *LEARNED)
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


def make_reference(setting: Measurement, path: str) -> dict[str, float]:
    """Write the exact posteriors to `path` for the other jobs; → figures about them."""
    rng = np.random.default_rng(setting.seed + 1)
    to = quality.reference(setting.model(), IN_USE, setting.readings, rng, bank=setting.bank)
    quality.save(to, Path(path))
    return {"floor": to.floor, "error": to.error, "left_out": to.left_out, "ms": to.ms}


def measure(setting: Measurement, group: str, reference: str, file: str) -> list[dict[str, Any]]:
    """Rows of all samplers of a group; a trained model is taken from a `file`, "" for one that
    ships."""
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
    setting: Measurement, group: str, model: ObservationModel, file: str
) -> Iterator[Tried]:
    if group == ALL_ANALYTIC:
        for name, make in ANALYTIC.items():
            yield Tried(name, make(model))
        return
    variant = MODELS[group]
    known = variants.sampler_of(variants.untrained(variant, model))
    sampler = trained.proposal_of(LEARNED[group], setting.place, file)
    name = "paper" if group == "paper" else known.family
    work = flops(known, quality.SAMPLES)
    yield Tried(name, sampler, known.steps, variant.network.width, work)
