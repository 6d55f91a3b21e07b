"""Cost of a call of each sampler on one thread, all measured in one run.

Cold: the calls of all samplers alternate, so that each finds its weights out of the caches, as
after a pause between touches. Warm: the calls of one sampler follow each other.

A model's cost depends on its network's sizes and not on what it has learned. So models are timed
untrained, exported as they would be shipped; the paper's is also run eagerly by torch. Rivals are
timed trained, as FMPE's adaptive solver takes more steps the more it has learned.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld.layout.layout import Layout
from taxeld.model.proposal import Proposal
from taxeld.proposals.sampler import Sampler
from taxeld_training.limits import quality
from taxeld_training.models.dataset import IN_USE, read
from taxeld_training.models.export import export
from taxeld_training.models.variants import Variant
from taxeld_training.samplers import experiment
from taxeld_training.samplers.experiment import Eager, Measurement, Tried

EAGER = "eager"  # DDPM-100 of width 256, step by step from Python
CALLS = 15  # counted, of each sampler; one more goes first


def time_calls(
    setting: Measurement, groups: tuple[tuple[str, Variant | None], ...]
) -> list[dict[str, Any]]:
    """Rows {proposal, steps, width, ms, ms_warm}: median CPU time of a call for SAMPLES samples,
    cold and warm; `groups` as in `experiment.measure`."""
    model = setting.model()
    rng = np.random.default_rng(0)
    readings = read(model, IN_USE, CALLS + 1, rng).z
    untrained = replace(setting, updates=0.0)
    with tempfile.TemporaryDirectory() as place:
        timed = [
            one
            for group, variant in groups
            for tried in experiment.samplers_of(untrained, group, variant, model)
            for one in _as_shipped(tried, model.layout, Path(place) / "sampler.onnx")
        ]
    samplers = [one.sampler for one in timed]
    cold, warm = cold_ms(samplers, readings, rng), warm_ms(samplers, readings, rng)
    return [
        {
            "proposal": one.proposal,
            "steps": one.steps,
            "width": one.width,
            "ms": ms,
            "ms_warm": ms_warm,
        }
        for one, ms, ms_warm in zip(timed, cold, warm, strict=True)
    ]


def cold_ms(
    samplers: Sequence[Proposal], readings: NDArray[np.float64], rng: np.random.Generator
) -> list[float]:
    """Each sampler's median over rounds of a call of every sampler [ms], the first left out."""
    rounds = [[_call_ms(sampler, z, rng) for sampler in samplers] for z in readings]
    return [float(ms) for ms in np.median(rounds[1:], axis=0)]


def warm_ms(
    samplers: Sequence[Proposal], readings: NDArray[np.float64], rng: np.random.Generator
) -> list[float]:
    """Each sampler's median over calls in a row [ms], the first left out."""
    return [
        float(np.median([_call_ms(sampler, z, rng) for z in readings][1:])) for sampler in samplers
    ]


def _call_ms(sampler: Proposal, z: NDArray[np.float64], rng: np.random.Generator) -> float:
    return quality.call_ms(sampler, z, np.ones(len(z), dtype=bool), rng)


def _as_shipped(tried: Tried, layout: Layout, path: Path) -> Iterator[Tried]:
    """A trained model as the daemon runs it, through the file `path`, and the paper's also as torch
    runs it; anything else as it is."""
    if not isinstance(tried.sampler, Eager):
        yield tried
        return
    export(tried.sampler.trained, len(layout), path, {})
    yield tried._replace(sampler=Sampler.read(path, layout, tried.sampler.name))
    if tried.proposal == "paper":
        yield tried._replace(proposal=EAGER)
