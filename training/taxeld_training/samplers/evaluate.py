"""`taxeld-train evaluate proposals` and `frontier`: samplers on objects and skins."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld_training.jobs import jobs, tables
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs, write
from taxeld_training.limits.rivals import RIVALS
from taxeld_training.models.variants import MODELS
from taxeld_training.objects import meshes
from taxeld_training.objects.setting import OBJECTS, ring
from taxeld_training.samplers import costs, experiment
from taxeld_training.samplers.experiment import Measurement

FRONTIER_COLUMNS = (16, 32)
GROUPS = {
    "proposals": ("analytic", "density-64", "paper"),
    "frontier": ("analytic", experiment.LARGE_TABLE, *MODELS, *RIVALS),
}
EAGER_GROUP, EAGER_SIZE = "paper", (100, 256)  # steps × width, to which speed-ups are relative
PROPOSALS = ("projection", "manifold", "table", "paper", "density", "exact")  # the paper's Fig. 2
PROPOSALS_KEYS = (
    "object", "columns", "proposal", "add_mm", "add_s_mm", "add_sym_mm", "contact_residual_mm",
    "observation_residual", "coverage_90", "energy_distance", "energy_floor", "contacts",
)  # fmt: skip


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
            replace(s, readings=8, contacts=40, slow_contacts=10, bank=50_000, updates=0.02,
                    epochs=2)
            for s in made
        ]  # fmt: skip
    return made


def rows(name: str, options: Options) -> list[dict[str, Any]]:
    """All rows of an experiment's samplers; those of the frontier have costs."""
    for group in options.groups:
        if group not in GROUPS["frontier"]:
            raise SetupError(f"--groups: no '{group}'; there are {', '.join(GROUPS['frontier'])}")
    for wanted in options.objects or OBJECTS:
        meshes.find(wanted)
    cells = settings(options, FRONTIER_COLUMNS if name == "frontier" else experiment.COLUMNS)
    memory = options.memory.resolve()
    first = [
        Job(f"reference-{s.name}", experiment.make_reference, (s, reference_file(s, memory)))
        for s in cells
    ]
    for job in first:
        if not Path(job.arguments[1]).is_file():
            jobs.forget(job, memory)
    references = run_jobs(first, options)
    second = [
        Job(
            f"{s.name}-{group}",
            experiment.measure,
            (s, group, reference_file(s, memory), MODELS.get(group)),
        )
        for s in cells
        if references[f"reference-{s.name}"] is not None
        for group in options.groups or GROUPS[name]
    ]
    measured = run_jobs(second, options)
    found = [row for job in second for row in measured[job.name] or []]
    if name != "frontier":
        return found
    timed: list[dict[str, Any]] = []
    for cell in {c.columns: c for c in reversed(cells)}.values():
        wanted_groups = dict.fromkeys((*(options.groups or GROUPS[name]), EAGER_GROUP))
        groups = tuple((group, MODELS.get(group)) for group in wanted_groups)
        job = Job(f"cost-{cell.columns}", costs.time_calls, (cell, groups))
        alone = run_jobs([job], replace(options, workers=1, until=math.inf))  # beside no other
        timed += [row | {"columns": cell.columns} for row in alone[job.name]]
    exact = {(s.object, s.columns): references[f"reference-{s.name}"]["ms"] for s in cells}
    return [_with_cost(row, timed, exact) for row in found]


def proposals(options: Options) -> list[Path]:
    """The paper's Fig. 2: errors of samples by object and resolution."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415  # matplotlib is not needed to train

    found = [
        {key: row[key] for key in PROPOSALS_KEYS}
        for row in rows("proposals", options) if row["proposal"] in PROPOSALS
    ]  # fmt: skip
    data = write(options, "proposals", found)
    tables.write(found, data)
    pictures = [data.with_suffix(".png"), data.with_name("proposals_posterior.png")]
    sampler_charts.proposals(found, pictures[0])
    sampler_charts.posterior_gap(found, pictures[1])
    return [data, *pictures]


def frontier(options: Options) -> list[Path]:
    """Cost against distance to the exact posterior."""
    from taxeld_training.charts import sampler_charts  # noqa: PLC0415

    found = rows("frontier", options)
    data = write(options, "frontier", found)
    tables.write(found, data)
    pictures = []
    for columns in sorted({row["columns"] for row in found}):
        pictures.append(data.with_name(f"frontier_{columns}.png"))
        sampler_charts.frontier(found, columns, pictures[-1])
    return [data, *pictures]


def reference_file(setting: Measurement, memory: Path) -> str:
    """The file of exact posteriors that the jobs of a measurement share."""
    return str(memory / f"exact-{Job(setting.name, experiment.make_reference, (setting,)).key}.npz")


def _with_cost(
    row: dict[str, Any], timed: list[dict[str, Any]], exact: dict[tuple[str, int], float]
) -> dict[str, Any]:
    def ms(proposal: str, steps: int | None, width: int | None) -> tuple[float, float]:
        wanted = {"proposal": proposal, "steps": steps, "width": width, "columns": row["columns"]}
        found = next(t for t in timed if wanted.items() <= t.items())
        return float(found["ms"]), float(found["ms_warm"])

    eager, eager_warm = ms(costs.EAGER, *EAGER_SIZE)
    if row["proposal"] == "exact":
        own = own_warm = exact[row["object"], row["columns"]]
    else:
        own, own_warm = ms(row["proposal"], row["steps"], row["width"])
    kept = {
        key: row[key]
        for key in ("object", "columns", "proposal", "steps", "width", "flops", "energy_distance",
                    "energy_floor", "coverage_90")
    }  # fmt: skip
    return kept | {
        "ms": own, "ms_eager_ddpm100": eager, "speedup": eager / own,
        "ms_warm": own_warm, "ms_eager_ddpm100_warm": eager_warm,
        "speedup_warm": eager_warm / own_warm,
    }  # fmt: skip
