"""The samplers of a bundle: trained, exported, measured, and put in the daemon's order.

Several models are trained. All of them and the analytic proposals are measured against the exact
posterior. The daemon runs by default the cheapest one that is as good as the best, so that a simple
object, such as a can, does not cost what a power drill costs.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from taxeld.model.contacts import Proposal
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_training.jobs.statistics import LEVEL, of_mean, rounded
from taxeld_training.limits import quality
from taxeld_training.models import export, variants
from taxeld_training.models.base import Model
from taxeld_training.models.dataset import FLOOR_MAX, IN_USE, simulate
from taxeld_training.models.variants import Variant

TOLERANCE = 1.15  # factor of the nearest proposal's distance up to which another is as good
VARIANTS = variants.density(64), variants.density(16, 48, 2)  # trained side by side

CONTACTS, TRAINING, MEASURING = "contacts", "training", "measuring"
STAGES = (CONTACTS, TRAINING, quality.BANK_STAGE, quality.EXACT_STAGE, MEASURING)

DISTANCES = "distances"  # of a sampler, reading by reading, for intervals and paired tests

Progress = Callable[[str, float], None]  # of a stage, and the share of it that is done


@dataclass(frozen=True)
class Candidates:
    """The models to be trained, and what their samplers are measured with."""

    variants: tuple[Variant, ...] = VARIANTS
    noise: Noise = IN_USE
    bank: int = 100_000
    readings: int = 100
    workers: int = 2
    seed: int = 0


def make(
    model: ObservationModel, given: Candidates, folder: Path, progress: Progress
) -> dict[str, Any]:
    """Train the candidates, export them into `folder` and measure them; → the part of bundle.json
    about samplers."""
    rng = np.random.default_rng(given.seed)
    most = max(v.training.contacts for v in given.variants)
    touches = simulate(model, most, rng, partial(progress, CONTACTS))
    torch.set_num_threads(1)  # more would wait for one another
    networks = variants.fit_beside(
        given.variants, model, given.noise, touches, partial(progress, TRAINING)
    )
    to = quality.reference(
        model,
        given.noise,
        given.readings,
        rng,
        bank=given.bank,
        workers=given.workers,
        progress=progress,
    )
    samplers = []
    for done, (variant, network) in enumerate(zip(given.variants, networks, strict=True), 1):
        samplers.append(_exported(variant, network, given, model, folder, to))
        progress(MEASURING, done / (len(networks) + 1))
    analytic = {name: _measured(make(model), to, given.seed) for name, make in ANALYTIC.items()}
    progress(MEASURING, 1.0)
    choice = choose({s["name"]: s for s in samplers} | analytic, TOLERANCE)
    return {
        "contacts_dropped_share": touches.dropped_share,
        "noise": asdict(given.noise),
        "samplers": [
            _stated(one) for one in sorted(samplers, key=lambda s: choice["order"].index(s["name"]))
        ],
        "analytic": {name: _stated(one) for name, one in analytic.items()},
        "energy_floor": to.floor,
        "auto": choice["order"],
        "choice": choice["why"],
        "measured": (
            f"mean energy distance of {quality.SAMPLES} samples to as many exact draws over "
            f"{len(to.z)} simulated readings as the filter sees them, 0 under floors of "
            f"{FLOOR:g} to {FLOOR_MAX:g} and where presses beside a taxel may explain it "
            f"({to.left_out} left out: too few effective contacts), by the likelihood that the "
            f"filter uses, turns weighed at {to.length_m:.4f} m; "
            f"the exact draws' own error is {to.error:.3f} posterior sd; ms is CPU time for "
            f"{quality.SAMPLES} samples on one thread"
        ),
    }


def choose(candidates: dict[str, dict[str, Any]], tolerance: float) -> dict[str, Any]:
    """The order in which the daemon prefers proposals {name: {energy_distance, ms, distances}}, and
    why.

    The cheapest that is shown to be within `tolerance` times the nearest one's distance comes
    first: over the readings that all have met, the excess is below zero by more than chance. A
    proposal that too few readings tell apart does not count as good. The others follow by distance.
    """
    best = min(candidates, key=lambda name: candidates[name]["energy_distance"])
    nearest = candidates[best]
    excess = {
        name: of_mean(
            [np.subtract(c[DISTANCES], tolerance * np.asarray(nearest[DISTANCES]))],
            np.random.default_rng(0),
        )[1]
        for name, c in candidates.items()
    }
    good = [name for name in candidates if name == best or excess[name] <= 0.0]
    first = min(good, key=lambda name: candidates[name]["ms"])
    rest = sorted(candidates.keys() - {first}, key=lambda n: candidates[n]["energy_distance"])
    chosen = candidates[first]
    why = (
        f"{first} is the cheapest ({chosen['ms']:.2f} ms) shown to be within {tolerance:g} × the "
        f"least distance to the exact posterior ({nearest['energy_distance']:.4f}, {best}, "
        f"{nearest['ms']:.2f} ms), {LEVEL:.0%} of bootstrap draws over "
        f"{len(nearest[DISTANCES])} readings"
    )
    return {"order": [first, *rest], "why": why}


def _exported(
    variant: Variant,
    network: Model,
    given: Candidates,
    model: ObservationModel,
    folder: Path,
    to: quality.Reference,
) -> dict[str, Any]:
    """Export the sampler of a trained model into `folder`, measure and describe it."""
    metadata = variant.describe() | {
        "noise": asdict(given.noise),
        "layout": model.layout.digest,
        "normalisation": {k: getattr(network, k).tolist() for k in ("mean", "scale")},
    }
    sampler = variants.sampler_of(network)
    size = sampler.steps if variant.family == "diffusion" else network.config.width
    path = folder / f"{sampler.family}-{size}.onnx"
    export.export(sampler, len(model.layout), path, metadata)
    return {
        "name": path.stem,
        "kind": variant.kind,
        "file": path.name,
        "steps": sampler.steps,
        "width": network.config.width,
        "flops": export.flops(sampler, quality.SAMPLES),
        **_measured(Sampler(path.read_bytes(), model.layout, variant.kind, path), to, given.seed),
    }


def _measured(proposal: Proposal, to: quality.Reference, seed: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    distances = quality.distances(proposal, to, rng)
    return {
        "energy_distance": float(distances.mean()),
        "energy_distance_ci": rounded(of_mean([distances], rng), 5),
        "ms": quality.cost_ms(proposal, to, rng),
        DISTANCES: distances,
    }


def _stated(measured: dict[str, Any]) -> dict[str, Any]:
    """A measurement as bundle.json has it."""
    return {key: value for key, value in measured.items() if key != DISTANCES}
