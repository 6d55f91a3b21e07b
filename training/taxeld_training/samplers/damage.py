"""`taxeld-train evaluate damage`: distance to the exact posterior by the share of dead taxels.

The samplers are those of the shipped bundles, so nothing is trained.
"""

from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_training.jobs import fingerprint
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.jobs.statistics import of_mean, p_paired, rounded
from taxeld_training.limits import quality
from taxeld_training.models.dataset import IN_USE
from taxeld_training.objects.setting import DEPTH_MAX_M
from taxeld_training.samplers import measured

BUNDLES = ("box", "mug")
SHARES = (0.0, 0.1, 0.2, 0.4, 0.6)
PROPOSALS = ("density", "ddpm", "table", "manifold")


def run(options: Options) -> list[Path]:
    """Rows and picture."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415  # matplotlib is not needed to train

    readings, bank = (8, 20_000) if options.quick else (64, quality.BANK)
    code = f"{measured.code()}-{fingerprint.of_bundles()}"
    todo = [
        Job(f"damage-{name}-{share:g}", measure, (name, share, readings, bank, options.seed, code))
        for name in BUNDLES
        for share in (SHARES[:2] if options.quick else SHARES)
    ]
    found = [row for rows in run_jobs(todo, options).values() for row in rows or []]
    data = write(options, "damage", found)
    sampler_charts.damage(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]


def measure(
    name: str, dead: float, readings: int, bank: int, seed: int, code: str
) -> list[dict[str, Any]]:
    """Rows of all proposals of a shipped bundle, a share `dead` of the taxels dead, drawn anew for
    each reading. `code` is part of the job's key alone."""
    del code
    loaded = bundle.load(name, layouts.load(SkinConfig().layout), DEPTH_MAX_M)
    rng = np.random.default_rng(seed)
    to = quality.reference(loaded.model, IN_USE, readings, rng, dead=dead, bank=bank)
    found = {kind: quality.distances(loaded.proposal(kind), to, rng) for kind in PROPOSALS}
    nearest = min(found.values(), key=lambda distances: float(distances.mean()))
    return [
        {
            "object": loaded.info["object"],
            "dead_share": dead,
            "proposal": kind,
            "energy_distance": float(distances.mean()),
            "energy_distance_ci": rounded(of_mean([distances], rng), 5),
            "p_nearest": p_paired(distances, nearest),
            "energy_floor": to.floor,
            "readings": len(to.z),
            "left_out": to.left_out,
        }
        for kind, distances in found.items()
    ]
