"""The samplers that experiments compare, on an object and a skin.

A `Measurement` names all that its rows depend on. Samplers come in groups: the analytic proposals,
one trained model, one rival.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from taxeld.arrays import Floats, Poses
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.analytic import ANALYTIC, Table
from taxeld_training.limits import quality
from taxeld_training.limits.rivals import CONTACTS, RIVALS, train_rival
from taxeld_training.models import variants
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.models.export import AnySampler, flops
from taxeld_training.models.variants import MODELS, Variant
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

COLUMNS = (8, 16, 32, 64)  # columns of the paper's skins, 5 rows each
LARGE_TABLE = "table-1e5"  # a table of ten times the contacts
GROUPS = {
    "proposals": ("analytic", "density-64", "paper"),
    "frontier": ("analytic", LARGE_TABLE, *MODELS, *RIVALS),
}
LEARNED = {
    "density-64": trained.DENSITY,
    "paper": trained.PAPER,
}  # models that are trained once for all experiments


@dataclass(frozen=True)
class Measurement(Setting):
    """A setting, and how thoroughly samplers are measured in it."""

    readings: int = 64  # readings with an exact posterior
    contacts: int = 1000  # contacts for errors against the truth
    slow_contacts: int = 200  # contacts for samplers that take long
    bank: int = quality.BANK
    epochs: int | None = None  # epochs of a rival's training; None: its own number

    @property
    def place(self) -> Setting:
        """The setting alone."""
        return Setting(self.object, self.skin, self.columns, self.updates, self.seed)


class Tried(NamedTuple):
    """A sampler to be measured, as the rows name it."""

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


def samplers_of(
    setting: Measurement, group: str, variant: Variant | None, model: ObservationModel,
    file: str | None = None,
) -> Iterator[Tried]:  # fmt: skip
    """The samplers of a group, trained for `setting.updates`, or one from a `file` ("" for one that
    ships)."""
    if group == "analytic":
        for name, make in ANALYTIC.items():
            yield Tried(name, None, None, None, make(model))
    elif group == LARGE_TABLE:
        yield Tried(group, None, None, None, Table(model, 100_000))
    elif variant is not None and file is not None:
        untrained = variants.untrained(variant, model)
        (known,) = variants.samplers(variant, untrained).values()
        yield _learned(
            group, variant, known, trained.proposal_of(LEARNED[group], setting.place, file)
        )
    elif variant is not None:
        variant = variants.trained_with(variant, setting.updates)
        rng = np.random.default_rng(setting.seed)
        touches = simulate(model, variant.training.contacts, rng)
        network = variants.fit(variant, model, IN_USE, touches)
        for sampler in variants.samplers(variant, network).values():
            yield _learned(group, variant, sampler, Eager(sampler))
    else:
        few = None if setting.epochs is None else CONTACTS  # a smoke run has no time for more
        rival = train_rival(
            group, model, IN_USE, seed=setting.seed, contacts=few, max_epochs=setting.epochs
        )
        yield Tried(group, None, None, None, rival)


def _learned(group: str, variant: Variant, known: AnySampler, sampler: Proposal) -> Tried:
    """`sampler`, of whose steps and sizes `known` tells."""
    name = "paper" if group == "paper" else known.family
    work = flops(known, quality.SAMPLES)
    return Tried(name, known.steps, variant.network.width, work, sampler)
