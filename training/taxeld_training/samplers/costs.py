"""Cost of a call of each sampler on one thread, all measured in one run.

Cold: the calls of all samplers alternate, so that each finds its weights out of the caches, as
after a pause between touches. Warm: the calls of one sampler follow each other.

A model's cost depends on its network's sizes and not on what it has learned. So models are timed
untrained, exported as they would be shipped; the paper's is also run eagerly by torch.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.models import variants
from taxeld_training.models.dataset import IN_USE, read
from taxeld_training.models.export import export
from taxeld_training.models.variants import MODELS
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import measured
from taxeld_training.samplers.measured import Eager, Tried

EAGER = "eager"  # `proposal` of the paper's DDPM-100 of width 256, step by step from Python
EAGER_GROUP = "paper"
CALLS = 15  # calls of each sampler that count; one more goes first


def time_calls(setting: Setting, groups: Sequence[str]) -> list[dict[str, Any]]:
    """Rows {proposal, steps, width, ms, ms_warm}: median CPU time of a call for SAMPLES samples,
    cold and warm, of all samplers of the groups."""
    model = setting.model()
    rng = np.random.default_rng(0)
    readings = read(model, IN_USE, CALLS + 1, rng).z
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "sampler.onnx"
        timed = [one for group in groups for one in _as_shipped(group, model, path)]
    samplers = [one.sampler for one in timed]
    cold, warm = cold_ms(samplers, readings, rng), warm_ms(samplers, readings, rng)
    sizes = [{"proposal": one.proposal, "steps": one.steps, "width": one.width} for one in timed]
    return [
        size | {"ms": ms, "ms_warm": ms_warm}
        for size, ms, ms_warm in zip(sizes, cold, warm, strict=True)
    ]


def cold_ms(
    samplers: Sequence[Proposal], readings: Floats, rng: np.random.Generator
) -> list[float]:
    """Each sampler's median over rounds of a call of every sampler [ms], the first left out, a
    round for each of the readings (n, M)."""
    rounds = [[_call_ms(sampler, z, rng) for sampler in samplers] for z in readings]
    return [float(ms) for ms in np.median(rounds[1:], axis=0)]


def warm_ms(
    samplers: Sequence[Proposal], readings: Floats, rng: np.random.Generator
) -> list[float]:
    """Each sampler's median over calls in a row [ms], the first left out, a call for each of the
    readings (n, M)."""
    return [
        float(np.median([_call_ms(sampler, z, rng) for z in readings][1:])) for sampler in samplers
    ]


def _call_ms(sampler: Proposal, z: Floats, rng: np.random.Generator) -> float:
    return quality.call_ms(sampler, z, np.ones(len(z), dtype=bool), rng)


def _as_shipped(group: str, model: ObservationModel, path: Path) -> Iterator[Tried]:
    """Samplers as the daemon runs them, learned ones through the file `path`."""
    if group not in MODELS:
        yield from measured.untrained(group, model)
        return
    variant = MODELS[group]
    network = variants.untrained(variant, model).eval()
    for sampler in variants.samplers(variant, network).values():
        export(sampler, len(model.layout), path, {})
        read_back = Sampler.read(path, model.layout, variant.kind)
        yield measured.learned(group, sampler, read_back)
        if group == EAGER_GROUP:
            eager = measured.learned(group, sampler, Eager(sampler))
            yield eager._replace(proposal=EAGER)
