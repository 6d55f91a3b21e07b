"""What a call of each sampler costs on one thread, side by side in one run.

Cost depends on the network's sizes and not on what it has learned, so models are timed untrained,
exported as they would be shipped, beside the paper's setting run eagerly by torch.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.bundle import ANALYTIC
from taxeld.observation import Noise
from taxeld.proposals import Proposal, Table
from taxeld.sampler import Sampler
from taxeld_training import variants
from taxeld_training.dataset import simulate
from taxeld_training.experiment import LARGE_TABLE, Eager, Setting, described
from taxeld_training.export import export
from taxeld_training.quality import SAMPLES
from taxeld_training.rivals import train_rival
from taxeld_training.variants import Variant

EAGER = "eager"  # DDPM-100 of width 256, step by step from Python
ROUNDS = 15


def measure(
    setting: Setting, groups: tuple[tuple[str, Variant | None], ...]
) -> list[dict[str, Any]]:
    """Rows {proposal, steps, width, ms}: median CPU time of SAMPLES samples over interleaved
    rounds; `groups` as in `experiment.measure`."""
    model = setting.model()
    rng = np.random.default_rng(0)
    touches = simulate(model, ROUNDS, rng)
    live = np.ones(len(model.layout), dtype=bool)
    rows: list[dict[str, Any]] = []
    timed: list[Proposal] = []

    def add(proposal: str, steps: int | None, width: int | None, sampler: Proposal) -> None:
        rows.append({"proposal": proposal, "steps": steps, "width": width})
        timed.append(sampler)

    some = simulate(model, 2000, rng)
    with tempfile.TemporaryDirectory() as place:
        for group, wanted in groups:
            if group == "analytic":
                for name, make in ANALYTIC.items():
                    add(name, None, None, make(model))
            elif group == LARGE_TABLE:
                add(group, None, None, Table(model, 100_000))
            elif wanted is not None:
                variant = variants.trained_with(wanted, 0.0)
                network = variants.fit(variant, model, Noise(), some, lambda _update, _loss: None)
                for name, sampler in variants.samplers(variant, network).items():
                    path = Path(place) / f"{group}-{name}.onnx"
                    export(sampler, len(model.layout), path, {})
                    tried = described(group, variant, sampler)
                    shipped = Sampler(path, model.layout, variant.kind)
                    add(tried.proposal, tried.steps, tried.width, shipped)
                    if group == "paper":
                        add(EAGER, tried.steps, tried.width, Eager(sampler))
            else:
                rival = train_rival(group, model, Noise(), contacts=300, max_epochs=1)
                add(group, None, None, rival)
        spent: list[list[float]] = [[] for _ in timed]
        for z in Noise().draw(touches.activation.astype(np.float64), rng):
            for each, proposal in zip(spent, timed, strict=True):
                start = time.thread_time_ns()
                proposal.propose(z, live, SAMPLES, rng)
                each.append((time.thread_time_ns() - start) / 1e6)
    for row, each in zip(rows, spent, strict=True):
        row["ms"] = float(np.median(each[1:]))
    return rows
