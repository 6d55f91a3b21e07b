"""The jobs that measure samplers on objects and skins, and their rows."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld_training.jobs import jobs
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs
from taxeld_training.jobs.rows import DISTANCES, EXACT
from taxeld_training.models.variants import MODELS
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS, ring
from taxeld_training.samplers import costs, experiment, measured, trainings
from taxeld_training.samplers.experiment import LEARNED, Measurement

FRONTIER_COLUMNS = (16, 32)
EAGER_GROUP, EAGER_SIZE = "paper", (100, 256)  # steps × width, to which speed-ups are relative
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
    memory = options.memory.resolve()
    first = [
        Job(
            f"reference-{s.name}", measured.make_reference, (s, measured.code()),
            (reference_file(s, memory),),
        )
        for s in cells
    ]  # fmt: skip
    for job in first:
        if not Path(job.beside[0]).is_file():
            jobs.forget(job, memory)
    references = run_jobs(first, options)
    groups = options.groups or experiment.GROUPS[name]
    wanted = {(s.place, LEARNED[g]) for s in cells for g in groups if g in LEARNED}
    files = trainings.files(wanted, options)
    second = [
        Job(
            f"{s.name}-{group}",
            measured.measure,
            (s, group, MODELS.get(group), measured.code()),
            (reference_file(s, memory), files.get((s.place, LEARNED.get(group, "")))),
        )
        for s in cells
        if references[f"reference-{s.name}"] is not None
        for group in groups
        if group not in LEARNED or (s.place, LEARNED[group]) in files
    ]
    done = run_jobs(second, options)
    found = [row for job in second for row in done[job.name] or []]
    if name != "frontier":
        return found
    timed: list[dict[str, Any]] = []
    for cell in {c.columns: c for c in reversed(cells)}.values():
        timed_groups = tuple((g, MODELS.get(g)) for g in dict.fromkeys((*groups, EAGER_GROUP)))
        job = Job(f"cost-{cell.columns}", costs.time_calls, (cell, timed_groups))
        alone = run_jobs([job], replace(options, workers=1, until=math.inf))  # beside no other
        timed += [row | {"columns": cell.columns} for row in alone[job.name]]
    exact = {(s.object, s.columns): references[f"reference-{s.name}"]["ms"] for s in cells}
    return [_with_cost(row, timed, exact) for row in found]


def reference_file(setting: Measurement, memory: Path) -> str:
    """The file of exact posteriors that the jobs of a measurement share."""
    job = Job(setting.name, measured.make_reference, (setting, measured.code()))
    return str(memory / f"exact-{job.key}.npz")


def _with_cost(
    row: dict[str, Any], timed: list[dict[str, Any]], exact: dict[tuple[str, int], float]
) -> dict[str, Any]:
    def ms(proposal: str, steps: int | None, width: int | None) -> tuple[float, float]:
        wanted = {"proposal": proposal, "steps": steps, "width": width, "columns": row["columns"]}
        found = next(t for t in timed if wanted.items() <= t.items())
        return float(found["ms"]), float(found["ms_warm"])

    eager, eager_warm = ms(costs.EAGER, *EAGER_SIZE)
    if row["proposal"] == EXACT:
        own = own_warm = exact[row["object"], row["columns"]]
    else:
        own, own_warm = ms(row["proposal"], row["steps"], row["width"])
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
