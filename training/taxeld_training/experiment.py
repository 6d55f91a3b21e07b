"""What the experiments measure: every sampler on an object and a skin, against the exact posterior.

A setting says all that a measurement depends on. Its groups (analytic proposals, one trained model,
one rival) are jobs of their own, which share the setting's reference through a file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from taxeld import layout as layouts
from taxeld.bundle import ANALYTIC
from taxeld.observation import Noise, ObservationModel
from taxeld.proposals import Proposal, Table
from taxeld.se2 import Poses
from taxeld_training import meshes, metrics, quality, scenes, variants
from taxeld_training.build import DEPTH_MAX_M, HEIGHT_M
from taxeld_training.dataset import simulate
from taxeld_training.diffusion import Solver
from taxeld_training.export import AnySampler, flops
from taxeld_training.rivals import train_rival
from taxeld_training.variants import Variant

OBJECTS = (
    "002_master_chef_can", "003_cracker_box", "006_mustard_bottle", "016_pear", "019_pitcher_base",
    "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "061_foam_brick",
)  # fmt: skip
COLUMNS = (8, 16, 32, 64)  # of the paper's skins, 5 rows each
LARGE_TABLE = "table-1e5"  # what a table of ten times the contacts buys

MODELS: dict[str, Variant] = {
    "density-64": variants.density(64),
    "density-16": variants.density(16, 48, 2),
    "diffusion-128": variants.diffusion(
        samplers=(
            (Solver.DPM, 4), (Solver.DPM, 10), (Solver.DDIM, 10), (Solver.DPM, 20),
            (Solver.DDPM, 100),
        )
    ),
    "paper": variants.paper(),
    "generator-128": variants.generator(128),
}  # fmt: skip

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Setting:
    """An object on a skin, and how thoroughly it is measured."""

    object: str
    skin: str  # a layout, as `skin.layout` has it
    columns: int  # of a generated cylinder; 0 for another layout
    readings: int = 64  # with an exact posterior
    contacts: int = 1000  # for errors against the truth
    slow_contacts: int = 200  # the same, of samplers that take long
    bank: int = quality.BANK
    updates: float = 1.0  # share of a variant's own
    epochs: int | None = None  # of a rival; None: its own
    seed: int = 0

    @property
    def name(self) -> str:
        return f"{Path(self.object).stem}-{self.columns or Path(self.skin).stem}"

    def model(self) -> ObservationModel:
        skin = layouts.load(self.skin)
        mesh = meshes.load(meshes.find(self.object)[0])
        return ObservationModel(scenes.build(mesh, skin, HEIGHT_M), skin, DEPTH_MAX_M)


def ring(columns: int) -> str:
    """The paper's skin of 5 rows."""
    return f"cylinder:rows=5,columns={columns},radius_m=0.04,pitch_m=0.015"


class Tried(NamedTuple):
    """A sampler to be measured, as the rows name it."""

    proposal: str
    steps: int | None
    width: int | None
    flops: int | None
    sampler: Proposal


class Eager:
    """A trained model as a proposal, without the detour through a file."""

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


def make_reference(setting: Setting, path: str) -> dict[str, float]:
    """The setting's exact posteriors, kept in `path` for its other jobs."""
    rng = np.random.default_rng(setting.seed + 1)
    to = quality.reference(setting.model(), Noise(), setting.readings, rng, bank=setting.bank)
    quality.save(to, Path(path))
    return {"floor": to.floor, "error": to.error, "left_out": to.left_out, "ms": to.ms}


def measure(
    setting: Setting, group: str, reference: str, variant: Variant | None
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


def draw(setting: Setting, reference: str, variant: Variant) -> dict[str, Any]:
    """Samples of one touch, the strongest of the setting's readings, by three samplers."""
    model = setting.model()
    make_reference(setting, reference)
    to = quality.load(Path(reference))
    i = int(np.argmax([z.max() for z in to.z]))
    rng = np.random.default_rng(setting.seed)
    projection = ANALYTIC["projection"](model)
    learned = next(samplers_of(setting, "", variant, model)).sampler
    z, live = to.z[i], to.live[i]
    return {
        "z": z.tolist(),
        "truth": to.truth[i].tolist(),
        "projection": projection.propose(z, live, quality.SAMPLES, rng).tolist(),
        "ddpm": learned.propose(z, live, quality.SAMPLES, rng).tolist(),
        "exact posterior": to.exact[i][: quality.SAMPLES].tolist(),
    }


def _named(setting: Setting, tried: Tried) -> dict[str, Any]:
    return {
        "object": setting.object,
        "columns": setting.columns,
        "proposal": tried.proposal,
        "steps": tried.steps,
        "width": tried.width,
        "flops": tried.flops,
    }


def samplers_of(
    setting: Setting, group: str, variant: Variant | None, model: ObservationModel
) -> Iterator[Tried]:
    """The samplers of a group, as `measure` has it, trained as the setting says."""
    if group == "analytic":
        for name, make in ANALYTIC.items():
            yield Tried(name, None, None, None, make(model))
    elif group == LARGE_TABLE:
        yield Tried(group, None, None, None, Table(model, 100_000))
    elif variant is not None:
        variant = variants.trained_with(variant, setting.updates)
        rng = np.random.default_rng(setting.seed)
        touches = simulate(model, variant.training.contacts, rng)
        network = variants.fit(variant, model, Noise(), touches, lambda _update, _loss: None)
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
