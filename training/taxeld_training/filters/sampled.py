"""`taxeld-train evaluate proposals --cells …`: how near the shipped samplers come to the posterior
of touches that they were not trained on: the touches of trials, under conditions of the table.

The posterior is by the likelihood that the shipped filter uses, which is what samples stand for.
"""

from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.estimator.intake import Intake
from taxeld.estimator.rule import EstimatorCounters
from taxeld.model import se2
from taxeld.model.observation import Observation, ObservationModel
from taxeld_hil.jobs import Job
from taxeld_training.filters import levels
from taxeld_training.filters.cells import SEEDS_APART, TOUCHES
from taxeld_training.filters.conditions import TrialConditions
from taxeld_training.filters.levels import Level
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.jobs.rows import distance_table
from taxeld_training.jobs.statistics import of_mean, rounded
from taxeld_training.limits import quality
from taxeld_training.models.dataset import IN_USE
from taxeld_training.objects.setting import Setting
from taxeld_training.samplers import trained

OBJECTS = ("003_cracker_box", "025_mug")  # objects of the shipped bundles
SEEDS = 15
ANALYTIC = (
    "projection",
    "manifold",
    "table",
)  # proposals that are measured beside the bundle's samplers
FLOOR = "floor"  # `proposal` of two sets of exact draws


def run(options: Options) -> list[Path]:
    """Rows {object, factor, level, proposal, energy_distance, …}, and a table of them.

    Raises:
        SetupError: no such cell, or no condition, or no bundle of an object is shipped.
    """
    bank, seeds = (20_000, 1) if options.quick else (quality.BANK, options.seeds or SEEDS)
    wanted = levels.chosen(options.cells)
    for level in wanted:
        if not level.changes_readings:
            raise SetupError(f"--cells: {level.name} changes no reading that samplers would meet")
    todo = {
        (name, level): Job(
            f"samples-{name}-{level.name}".replace("/", " of "),
            measure,
            (level.setting(name, options), level, bank, seeds),
        )
        for level in wanted
        for name in options.objects or OBJECTS
    }
    done = run_jobs(list(todo.values()), options)
    found = [
        {"object": name, "factor": level.factor, "level": level.level} | row
        for (name, level), job in todo.items()
        for row in done[job.name] or []
    ]
    data = write(options, "proposals_cells", found, distance_table(found))
    return [data, data.with_suffix(".md")]


def measure(setting: Setting, level: Level, bank: int, trials: int) -> list[dict[str, Any]]:
    """Rows of all proposals on the touches of `trials` trials.

    Raises:
        SetupError: no bundle of the object is shipped.
    """
    bundle = trained.shipped_with(setting)
    felt = firmest(bundle.model, setting.seed, trials, level.conditions)
    rng = np.random.default_rng(setting.seed)
    to = quality.reference(bundle.model, IN_USE, felt, rng, bank=bank)
    found = {FLOOR: to.floors} | {
        name: quality.distances(bundle.open(name), to, np.random.default_rng(setting.seed))
        for name in (*ANALYTIC, *(sampler["name"] for sampler in bundle.info["samplers"]))
    }
    return [
        {
            "proposal": proposal,
            "energy_distance": float(distances.mean()),
            "energy_distance_ci": rounded(of_mean([distances], rng)),
            "median": float(np.median(distances)),
            "touches": len(distances),
            "left_out": to.left_out,
        }
        for proposal, distances in found.items()
    ]


def firmest(
    model: ObservationModel, seed: int, trials: int, given: TrialConditions
) -> list[tuple[Poses, Observation]]:
    """For each touch that is felt in `trials` trials: the object's pose (3,) in the sensor frame at
    the firmest scan, and that scan."""
    found: list[tuple[Poses, Observation]] = []
    for own in range(SEEDS_APART * seed, SEEDS_APART * seed + trials):
        intake = Intake(model, EstimatorCounters())
        best: dict[int, tuple[Poses, Observation]] = {}
        for scan in Trial(model, own, TOUCHES, given):
            seen = intake.observation(scan.activation, scan.sensor)
            if seen is None or not seen.is_contact:
                continue
            if scan.touch not in best or seen.z.sum() > best[scan.touch][1].z.sum():
                pose = se2.compose(se2.inverse(scan.sensor), scan.truth)
                best[scan.touch] = pose, seen
        found += best.values()
    return found
