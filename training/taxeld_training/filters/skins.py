"""`taxeld-train evaluate skins`: how near the shipped samplers come to the posterior of touches
that they were not trained on: those of trials, on the estimator's own model of a skin and on soft
skins.

The posterior is by the likelihood that the shipped filter uses, which is what samples stand for.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_training.filters import cells, methods, touches
from taxeld_training.filters.conditions import Conditions
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.jobs.statistics import of_mean, rounded
from taxeld_training.limits.posterior import energy_distance
from taxeld_training.limits.quality import BANK, LIMIT_ESS, SAMPLES, Posterior
from taxeld_training.models.dataset import IN_USE, simulate
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

OBJECTS = ("003_cracker_box", "025_mug")  # of the shipped bundles
SKINS = {"model": "", "typical": "typical", "poor": "poor"}
SEEDS = 15
ANALYTIC = ("projection", "table")  # beside the bundle's samplers
FLOOR = "floor"  # `proposal` of two sets of exact draws


def run(options: Options) -> list[Path]:
    """Rows {object, skin, proposal, energy_distance, …}, and a table of them."""
    bank, seeds = (20_000, 1) if options.quick else (BANK, options.seeds or SEEDS)
    code = methods.code("density")
    todo = [
        Job(
            f"skins-{name}-{skin}", measure,
            (cells.setting_of(name, cells.COLUMNS, options), skin, bank, seeds, code),
        )
        for name in options.objects or OBJECTS
        for skin in SKINS
    ]  # fmt: skip
    found = [row for rows in run_jobs(todo, options).values() for row in rows or []]
    data = write(options, "skins", found)
    table = data.with_suffix(".md")
    table.write_text(_table(found), encoding="utf-8")
    return [data, table]


def measure(setting: Setting, skin: str, bank: int, seeds: int, code: str) -> list[dict[str, Any]]:
    """Rows of all proposals on one skin. `code` is part of the job's key alone.

    Raises:
        SetupError: no bundle of the object is shipped.
    """
    del code
    bundle = trained.shipped_with(setting)
    model, rng = bundle.model, np.random.default_rng(setting.seed)
    posterior = Posterior(model, simulate(model, bank, rng), IN_USE, rng)
    first = cells.SEEDS_APART * setting.seed
    trials = range(first, first + seeds)
    felt = touches.firmest(model, trials, cells.TOUCHES, Conditions(skin=SKINS[skin]))
    drawn = [(seen, posterior.sample(seen, 2 * SAMPLES, rng)) for seen in felt]
    known = [(seen, draws.pose) for seen, draws in drawn if draws.ess >= LIMIT_ESS]
    length_m = model.scene.size
    distances = {FLOOR: [energy_distance(e[SAMPLES:], e[:SAMPLES], length_m) for _, e in known]}
    for proposal in (*ANALYTIC, *(sampler["name"] for sampler in bundle.info["samplers"])):
        sampler, own = bundle.open(proposal), np.random.default_rng(setting.seed)
        distances[proposal] = [
            energy_distance(
                sampler.propose(seen.z, seen.live, SAMPLES, own), exact[:SAMPLES], length_m
            )
            for seen, exact in known
        ]
    return [
        {
            "object": setting.object,
            "skin": skin,
            "proposal": proposal,
            "energy_distance": float(np.mean(values)),
            "energy_distance_ci": rounded(of_mean([values], rng)),
            "median": float(np.median(values)),
            "touches": len(values),
            "left_out": len(felt) - len(values),
        }
        for proposal, values in distances.items()
    ]


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """A line an object and skin, a column a proposal: mean distance (median)."""
    proposals = list(dict.fromkeys(row["proposal"] for row in rows))
    lines = [f"| object | skin | {' | '.join(proposals)} |", "| --- " * (2 + len(proposals)) + "|"]
    for name, skin in dict.fromkeys((row["object"], row["skin"]) for row in rows):
        mine = {
            row["proposal"]: f"{row['energy_distance']:.3f} ({row['median']:.3f})"
            for row in rows
            if (row["object"], row["skin"]) == (name, skin)
        }
        lines.append(f"| {name} | {skin} | {' | '.join(mine[p] for p in proposals)} |")
    return "\n".join(lines) + "\n"
