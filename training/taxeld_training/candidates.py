"""The samplers of a bundle: trained, exported, measured, and put in the daemon's order.

Several models are trained. All of them and the analytic proposals are measured against the exact
posterior. The daemon runs by default the cheapest one that is as good as the best, so that a simple
object, such as a can, does not cost what a power drill costs.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld.model.contacts import Proposal
from taxeld.model.noise import FLOOR
from taxeld.model.observation import ObservationModel
from taxeld.proposals.analytic import ANALYTIC
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.models import export, variants
from taxeld_training.models.base import Model
from taxeld_training.models.dataset import FLOOR_MAX, IN_USE, simulate
from taxeld_training.models.variants import Variant

TOLERANCE = 1.15  # factor of the nearest proposal's distance up to which another is as good
LEVEL, DRAWS = 0.95, 400  # of intervals by bootstrap
VARIANTS = variants.density(64), variants.density(16, 48, 2)  # trained side by side
CONTACTS_OF, BANK_OF, READINGS_OF = (30_000, 300_000), (50_000, 100_000), (10, 100)  # least, full
MOST_EFFORT = 100.0
WORKERS = 2

CONTACTS, TRAINING, MEASURING = "contacts", "training", "measuring"
STAGES = (CONTACTS, TRAINING, quality.BANK_STAGE, quality.EXACT_STAGE, MEASURING)


@dataclass(frozen=True)
class Candidates:
    """The models to be trained, and what their samplers are measured with."""

    variants: tuple[Variant, ...]
    bank: int  # contacts that exact posteriors begin with
    readings: int


class Nearness(NamedTuple):
    """A proposal against the exact posteriors of readings."""

    distances: Floats  # (readings,)
    ms: float  # CPU time of a call

    def stated(self) -> dict[str, Any]:
        """As bundle.json has it."""
        ends = [round(end, 5) for end in interval(self.distances)]
        mean = float(self.distances.mean())
        return {"energy_distance": mean, "energy_distance_ci": ends, "ms": self.ms}


def of(effort: float, *, ddpm: bool = False) -> Candidates:
    """The models that a build trains, with a share of their full training, measured as well as
    that is worth. Raises SetupError."""
    if not 0.0 < effort <= MOST_EFFORT:
        raise SetupError(f"--effort: must be over 0 and at most {MOST_EFFORT:g}, not {effort:g}")
    contacts, bank, readings = (
        round(max(least, min(effort, 1.0) * full))
        for least, full in (CONTACTS_OF, BANK_OF, READINGS_OF)
    )
    wanted = (*VARIANTS, variants.diffusion()) if ddpm else VARIANTS
    given = tuple(variants.trained_with(one, effort, contacts) for one in wanted)
    return Candidates(given, bank, readings)


def make(
    model: ObservationModel,
    given: Candidates,
    folder: Path,
    progress: Callable[[str, float], None],
) -> dict[str, Any]:
    """Train the candidates, export them into `folder` and measure them; → the part of bundle.json
    about samplers. `progress` is told each of `STAGES`, and the share of it that is done."""
    rng = np.random.default_rng(0)
    most = max(v.training.contacts for v in given.variants)
    touches = simulate(model, most, rng, partial(progress, CONTACTS))
    torch.set_num_threads(1)  # more would wait for one another
    told = partial(progress, TRAINING)
    networks = variants.fit(given.variants, model, IN_USE, touches, told)
    how = {"bank": given.bank, "workers": WORKERS}
    to = quality.reference(model, IN_USE, given.readings, rng, **how, progress=progress)
    samplers: dict[str, dict[str, Any]] = {}
    measured: dict[str, Nearness] = {}
    for variant, network in zip(given.variants, networks, strict=True):
        path, about = _exported(variant, network, model, folder)
        proposal = Sampler(path.read_bytes(), model.layout, variant.kind, path)
        measured[path.stem], samplers[path.stem] = _measured(proposal, to), about
        progress(MEASURING, len(samplers) / (len(networks) + 1))
    measured |= {name: _measured(make(model), to) for name, make in ANALYTIC.items()}
    progress(MEASURING, 1.0)
    order, why = choose(measured)
    return {
        "contacts_dropped_share": touches.dropped_share,
        "noise": asdict(IN_USE),
        "samplers": [samplers[k] | measured[k].stated() for k in order if k in samplers],
        "analytic": {name: measured[name].stated() for name in ANALYTIC},
        "energy_floor": to.floor,
        "auto": order,
        "choice": why,
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


def choose(given: Mapping[str, Nearness], tolerance: float = TOLERANCE) -> tuple[list[str], str]:
    """The order in which the daemon prefers proposals, and why.

    The cheapest that is shown to be within `tolerance` times the nearest one's distance comes
    first: over the readings that all have met, the excess is below zero by more than chance. A
    proposal that too few readings tell apart does not count as good. The others follow by distance.
    """
    mean = {name: float(one.distances.mean()) for name, one in given.items()}
    best = min(mean, key=lambda name: mean[name])
    nearest = given[best]
    good = [
        name
        for name, one in given.items()
        if name == best or interval(one.distances - tolerance * nearest.distances)[1] <= 0.0
    ]
    first = min(good, key=lambda name: given[name].ms)
    why = (
        f"{first} is the cheapest ({given[first].ms:.2f} ms) shown to be within {tolerance:g} × "
        f"the least distance to the exact posterior ({mean[best]:.4f}, {best}, {nearest.ms:.2f} "
        f"ms), {LEVEL:.0%} of bootstrap draws over {len(nearest.distances)} readings"
    )
    return [first, *sorted(given.keys() - {first}, key=lambda name: mean[name])], why


def interval(values: Floats) -> tuple[float, float]:
    """Interval of the mean of values (n,), by drawing them anew."""
    found = stats.bootstrap(
        (values,), np.mean, n_resamples=DRAWS, confidence_level=LEVEL, method="percentile", rng=0
    ).confidence_interval
    return float(found.low), float(found.high)


def _exported(
    variant: Variant, network: Model, model: ObservationModel, folder: Path
) -> tuple[Path, dict[str, Any]]:
    """Export the sampler of a trained model into `folder`; → its file, and what describes it."""
    metadata = asdict(variant) | {
        "noise": asdict(IN_USE),
        "layout": model.layout.digest,
        "normalisation": {k: getattr(network, k).tolist() for k in ("mean", "scale")},
    }
    sampler = variants.sampler_of(network)
    size = sampler.steps if variant.family == "diffusion" else network.config.width
    path = folder / f"{sampler.family}-{size}.onnx"
    export.export(sampler, len(model.layout), path, metadata)
    return path, {
        "name": path.stem,
        "kind": variant.kind,
        "file": path.name,
        "steps": sampler.steps,
        "width": network.config.width,
        "flops": export.flops(sampler, quality.SAMPLES),
    }


def _measured(proposal: Proposal, to: quality.Reference) -> Nearness:
    rng = np.random.default_rng(0)
    return Nearness(quality.distances(proposal, to, rng), quality.cost_ms(proposal, to, rng))
