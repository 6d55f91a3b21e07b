"""The jobs that measure samplers on objects and skins, and their rows."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld_hil.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, with_file
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.models.variants import MODELS
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS, ring
from taxeld_training.samplers import costs, experiment, measured, trainings
from taxeld_training.samplers.experiment import LEARNED, Measurement

FRONTIER_COLUMNS = (16, 32)
EAGER_GROUP, EAGER_SIZE = "paper", (100, 256)  # steps × width, to which speed-ups are relative
# ms of a call, cold and warm, by object, columns, proposal, steps and width
Costs: TypeAlias = dict[tuple[str, int, str, int | None, int | None], tuple[float, float]]
DISTANCE_KEYS = (
    "energy_distance",
    "energy_distance_ci",
    "energy_floor",
    "left_out",
    DISTANCES,
)


def settings(options: Options, columns: Sequence[int]) -> list[Measurement]:
    """The cells of an experiment, column by column, so that a run cut short has whole columns."""
    objects = options.objects or OBJECTS
    skins = [(c, ring(c)) for c in options.columns or columns]
    if options.skin:
        skins = [(0, options.skin)]
    if options.quick:
        objects, skins = objects[:2], skins[:1]
    made = [
        Measurement(name, skin, count, updates=options.effort, seed=options.seed)
        for count, skin in skins
        for name in objects
    ]
    if options.quick:
        made = [
            replace(s, readings=8, contacts=40, slow_contacts=10, bank=20_000, updates=0.005,
                    epochs=2)
            for s in made
        ]  # fmt: skip
    return made


def rows(name: str, options: Options) -> list[dict[str, Any]]:
    """All rows of an experiment's samplers; those of the frontier have costs."""
    for group in options.groups:
        if group not in (known := experiment.GROUPS["frontier"]):
            raise SetupError(f"--groups: no '{group}'; there are {', '.join(known)}")
    for mesh in options.objects or OBJECTS:
        meshes.find(mesh)
    cells = settings(options, FRONTIER_COLUMNS if name == "frontier" else experiment.COLUMNS)
    exact = {s: with_file(_reference(s), options.memory, ".npz") for s in cells}
    references = run_jobs(list(exact.values()), options)
    groups = options.groups or experiment.GROUPS[name]
    wanted = {(s.place, LEARNED[g]) for s in cells for g in groups if g in LEARNED}
    files = trainings.files(wanted, options)
    second = [
        Job(
            f"{s.name}-{group}",
            measured.measure,
            (s, group, MODELS.get(group), measured.code()),
            (*exact[s].beside, files.get((s.place, LEARNED.get(group, "")))),
        )
        for s in cells
        if references[exact[s].name] is not None
        for group in groups
        if group not in LEARNED or (s.place, LEARNED[group]) in files
    ]
    done = run_jobs(second, options)
    found = [row for job in second for row in done[job.name] or []]
    if name != "frontier" or not found:
        return found
    ms: Costs = {
        (s.object, s.columns, EXACT, None, None): (references[job.name]["ms"],) * 2
        for s, job in exact.items()
        if references[job.name] is not None
    }
    for cell in {c.columns: c for c in reversed(cells)}.values():
        timed_groups = tuple((g, MODELS.get(g)) for g in dict.fromkeys((*groups, EAGER_GROUP)))
        job = Job(f"cost-{cell.columns}", costs.time_calls, (cell, timed_groups))
        alone = run_jobs([job], replace(options, workers=1, until=math.inf))  # beside no other
        for row in alone[job.name]:
            size = row["proposal"], row["steps"], row["width"]
            ms |= {(s.object, cell.columns, *size): (row["ms"], row["ms_warm"]) for s in cells}
    return [_with_cost(row, ms) for row in found]


def _reference(setting: Measurement) -> Job:
    """The job that makes the exact posteriors, a file that all others of a measurement share."""
    return Job(f"reference-{setting.name}", measured.make_reference, (setting, measured.code()))


def _with_cost(row: dict[str, Any], ms: Costs) -> dict[str, Any]:
    place = row["object"], row["columns"]
    own, own_warm = ms[*place, row["proposal"], row["steps"], row["width"]]
    eager, eager_warm = ms[*place, costs.EAGER, *EAGER_SIZE]
    kept = {
        key: row[key]
        for key in ("object", "columns", "proposal", "steps", "width", "flops", *DISTANCE_KEYS,
                    "coverage_90", "coverage_90_ci")
    }  # fmt: skip
    return kept | {
        "ms": own, "ms_eager_ddpm100": eager, "speedup": eager / own,
        "ms_warm": own_warm, "ms_eager_ddpm100_warm": eager_warm,
        "speedup_warm": eager_warm / own_warm,
    }  # fmt: skip
