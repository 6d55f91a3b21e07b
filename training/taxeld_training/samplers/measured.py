"""Measurements of samplers on an object and a skin, against the exact posterior.

Each group of samplers is a job of its own; the jobs share the exact posteriors through a file.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.proposals.analytic import ANALYTIC
from taxeld_training.jobs import fingerprint
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.jobs.statistics import of_mean, rounded
from taxeld_training.limits import metrics, quality
from taxeld_training.models.dataset import IN_USE, read
from taxeld_training.models.variants import Variant
from taxeld_training.samplers.experiment import Measurement, Tried, samplers_of

ROOMS = "taxeld.model", "taxeld.proposals", "taxeld_training.models", "taxeld_training.limits"


def code() -> str:
    """Of what decides a sampler's rows, so that other code is another job."""
    return fingerprint.of(*ROOMS) + fingerprint.of_bundles()


def make_reference(setting: Measurement, code: str, path: str) -> dict[str, float]:
    """Write the exact posteriors to `path` for the other jobs; → figures about them. `code` is part
    of the job's key alone."""
    del code
    rng = np.random.default_rng(setting.seed + 1)
    to = quality.reference(setting.model(), IN_USE, setting.readings, rng, bank=setting.bank)
    quality.save(to, Path(path))
    return {"floor": to.floor, "error": to.error, "left_out": to.left_out, "ms": to.ms}


def measure(
    setting: Measurement, group: str, variant: Variant | None, code: str, reference: str,
    file: str | None = None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of all samplers of a group: `analytic`, a rival of sbi, or a model by its variant, new
    or from a `file` ("" for one that ships). `code` is part of the job's key alone."""
    del code
    model = setting.model()
    to = quality.load(Path(reference))
    rng = np.random.default_rng(setting.seed + 2)
    seen = read(model, IN_USE, setting.contacts, rng)

    def row(
        tried: Tried, z: Floats, truth: Poses, samples: Sequence[Poses], distances: Floats
    ) -> dict[str, Any]:
        return {
            **_named(setting, tried),
            **metrics.summary(model, z, truth, samples, rng),
            "energy_distance": float(distances.mean()),
            "energy_distance_ci": rounded(of_mean([distances], rng), 5),
            "energy_floor": to.floor,
            "left_out": to.left_out,
            DISTANCES: [round(value, 5) for value in distances.tolist()],
        }

    rows = []
    for tried in samplers_of(setting, group, variant, model, file):
        slow = tried.sampler.name in ("npse", "fmpe") or (tried.steps or 0) > 50
        count = setting.slow_contacts if slow else setting.contacts
        some = zip(seen.z[:count], seen.live[:count], strict=True)
        samples = [tried.sampler.propose(z, live, quality.SAMPLES, rng) for z, live in some]
        distances = quality.distances(tried.sampler, to, rng)
        rows.append(row(tried, seen.z[:count], seen.pose[:count], samples, distances))
    if group == "analytic":
        limit = Tried(EXACT, None, None, None, ANALYTIC["projection"](model))
        exact = list(to.exact[:, : quality.SAMPLES])
        rows.append(row(limit, to.z, to.truth, exact, to.floors))
    return rows


def _named(setting: Measurement, tried: Tried) -> dict[str, Any]:
    return {
        "object": setting.object,
        "columns": setting.columns,
        "proposal": tried.proposal,
        "steps": tried.steps,
        "width": tried.width,
        "flops": tried.flops,
    }
