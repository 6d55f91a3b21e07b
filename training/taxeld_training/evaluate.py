"""`taxeld-train evaluate`: experiments from jobs to JSON and PNG."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.errors import SetupError
from taxeld_training import costs, experiment, jobs, meshes, quality, tables, variants
from taxeld_training.diffusion import Solver
from taxeld_training.experiment import MODELS, Setting, ring
from taxeld_training.jobs import Job
from taxeld_training.rivals import RIVALS

FRONTIER_COLUMNS = (16, 32)
GROUPS = {
    "proposals": ("analytic", "density-64", "paper"),
    "frontier": ("analytic", experiment.LARGE_TABLE, *MODELS, *RIVALS),
}
GALLERY_OBJECT, GALLERY_COLUMNS = "025_mug", (16,)
GALLERY_MODEL = variants.diffusion(samplers=((Solver.DDPM, 100),))
EAGER_GROUP, EAGER_SIZE = "paper", (100, 256)  # what speed-ups are relative to: steps × width
PROPOSALS = ("projection", "manifold", "table", "paper", "density", "exact")  # the paper's Fig. 2
PROPOSALS_KEYS = (
    "object", "columns", "proposal", "add_mm", "add_s_mm", "add_sym_mm", "contact_residual_mm",
    "observation_residual", "coverage_90", "energy_distance", "energy_floor", "contacts",
)  # fmt: skip


@dataclass(frozen=True)
class Options:
    """How an experiment is run."""

    out: Path
    memory: Path
    objects: tuple[str, ...] = experiment.OBJECTS
    columns: tuple[int, ...] = ()  # empty: the experiment's own
    skin: str = ""  # another layout instead of the rings
    quick: bool = False
    workers: int = 2
    dask: str = ""
    groups: tuple[str, ...] = ()  # of samplers; empty: the experiment's own
    until: float = math.inf  # of the monotonic clock: what has not begun by then is left out
    effort: float = 1.0  # share of each model's own training
    seeds: int = 0  # trials a cell of the filter's experiments; 0: the experiment's own
    seed: int = 0


def settings(options: Options, columns: Sequence[int]) -> list[Setting]:
    """The cells of an experiment, columns first: a cut-short run has whole columns."""
    objects = options.objects
    skins = [(c, ring(c)) for c in options.columns or columns]
    if options.skin:
        skins = [(0, options.skin)]
    if options.quick:
        objects, skins = objects[:2], skins[:1]
    made = [
        Setting(name, skin, count, updates=options.effort, seed=options.seed)
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
    """All rows of an experiment's samplers, with their costs in those of the frontier."""
    for group in options.groups:
        if group not in GROUPS["frontier"]:
            raise SetupError(f"--groups: no '{group}'; there are {', '.join(GROUPS['frontier'])}")
    for wanted in options.objects:
        meshes.find(wanted)
    cells = settings(options, FRONTIER_COLUMNS if name == "frontier" else experiment.COLUMNS)
    memory = options.memory.resolve()
    first = [
        Job(f"reference-{s.name}", experiment.make_reference, (s, _kept(s, memory))) for s in cells
    ]
    for job in first:
        if not Path(job.arguments[1]).is_file():
            jobs.forget(job, memory)
    references = run_jobs(first, options)
    second = [
        Job(
            f"{s.name}-{group}", experiment.measure, (s, group, _kept(s, memory), MODELS.get(group))
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


def run_jobs(todo: list[Job], options: Options) -> dict[str, Any]:
    """Results by job name, as `jobs.run` has it."""
    return jobs.run(
        todo, options.memory, workers=options.workers, dask=options.dask, until=options.until
    )


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


def proposals(options: Options) -> list[Path]:
    """The paper's Fig. 2: errors of samples by object and resolution."""
    from taxeld_training import charts  # noqa: PLC0415  # matplotlib is not needed to train

    found = [
        {key: row[key] for key in PROPOSALS_KEYS}
        for row in rows("proposals", options) if row["proposal"] in PROPOSALS
    ]  # fmt: skip
    data = write(options, "proposals", found)
    tables.write(found, data)
    pictures = [data.with_suffix(".png"), data.with_name("proposals_posterior.png")]
    charts.proposals(found, pictures[0])
    charts.posterior_gap(found, pictures[1])
    return [data, *pictures]


def frontier(options: Options) -> list[Path]:
    """The chart: cost against distance to the exact posterior."""
    from taxeld_training import charts  # noqa: PLC0415

    found = rows("frontier", options)
    data = write(options, "frontier", found)
    tables.write(found, data)
    pictures = []
    for columns in sorted({row["columns"] for row in found}):
        pictures.append(data.with_name(f"frontier_{columns}.png"))
        charts.frontier(found, columns, pictures[-1])
    return [data, *pictures]


def write(options: Options, name: str, found: list[dict[str, Any]]) -> Path:
    """Rows as the experiment's JSON file."""
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / f"{name}.json"
    lines = ",\n".join(json.dumps(row) for row in found)  # a row a line: a diff can be read
    path.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    return path


def _kept(setting: Setting, memory: Path) -> str:
    return str(memory / f"exact-{Job(setting.name, experiment.make_reference, (setting,)).key}.npz")


def gallery(options: Options) -> list[Path]:
    """The paper's Fig. 1: contacts generated for one touch of the mug, of which the most telling
    (the one with the strongest reading of a few) is drawn."""
    from taxeld_training import gallery as drawing  # noqa: PLC0415

    name = options.objects[0] if len(options.objects) == 1 else GALLERY_OBJECT
    cell = settings(replace(options, objects=(name,)), GALLERY_COLUMNS)[0]
    cell = replace(cell, readings=8)
    memory = options.memory.resolve()
    path = _kept(cell, memory)
    job = Job(f"gallery-{cell.name}", experiment.draw, (cell, path, GALLERY_MODEL))
    drawn = run_jobs([job], options)[job.name]
    panels = {key: np.array(drawn[key]) for key in ("projection", "ddpm", "exact posterior")}
    options.out.mkdir(parents=True, exist_ok=True)
    picture = options.out / "gallery.png"
    drawing.gallery(cell.model(), panels, np.array(drawn["z"]), np.array(drawn["truth"]), picture)
    return [picture]


def damage(options: Options) -> list[Path]:
    """Dead taxels: the shipped bundles' samplers beside the table."""
    from taxeld_training import damage as dead  # noqa: PLC0415

    readings, bank = (8, 50_000) if options.quick else (64, quality.BANK)
    shares = dead.SHARES[:2] if options.quick else dead.SHARES
    todo = [
        Job(f"damage-{name}-{share:g}", dead.measure, (name, share, readings, bank, options.seed))
        for name in dead.BUNDLES
        for share in shares
    ]
    found = [row for rows in run_jobs(todo, options).values() for row in rows or []]
    data = write(options, "damage", found)
    dead.draw(found, data.with_suffix(".png"))
    return [data, data.with_suffix(".png")]
