"""`taxeld-train evaluate proposals`: samplers on objects and skins."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from taxeld_hil.jobs import Job, layout_name
from taxeld_hil.objects import meshes
from taxeld_training.jobs.options import Options, check, run_jobs, with_file, write
from taxeld_training.jobs.rows import sampler_table
from taxeld_training.objects.setting import OBJECTS, ring
from taxeld_training.samplers import measured, trained
from taxeld_training.samplers.measured import GROUPS, LEARNED, Measurement

PROPOSALS_COLUMNS = (8, 16, 32, 64)  # columns of the paper's skins, 5 rows each


def proposals(options: Options) -> list[Path]:
    """The paper's Fig. 2: errors of samples by object and resolution."""
    cells = settings(options, PROPOSALS_COLUMNS)
    found = rows(cells, options.groups or GROUPS, options)
    return [write(options, f"proposals{_of_skin(options)}", found, sampler_table(found))]


def settings(options: Options, columns: Sequence[int]) -> list[Measurement]:
    """The cells of an experiment, column by column, so that a run cut short has whole columns."""
    objects = options.objects or OBJECTS
    (layout,) = options.layouts
    skins = [(0, layout)] if layout else [(c, ring(c)) for c in options.columns or columns]
    if options.quick:
        objects, skins = objects[:2], skins[:1]
    made = [
        Measurement(name, skin, count, updates=options.effort, seed=options.seed)
        for count, skin in skins
        for name in objects
    ]
    if not options.quick:
        return made
    return [
        replace(cell, readings=8, contacts=40, slow_contacts=10, bank=20_000, updates=0.005)
        for cell in made
    ]


def rows(
    cells: Sequence[Measurement], groups: Sequence[str], options: Options
) -> list[dict[str, Any]]:
    """All rows of the groups' samplers.

    Raises:
        SetupError: no such group or object.
    """
    check("--groups", groups, GROUPS)
    for mesh in {cell.object for cell in cells}:
        meshes.find(mesh)
    exact = {
        cell: with_file(
            Job(f"reference-{cell.name}", measured.make_reference, (cell,)),
            options.measured,
            ".joblib",
        )
        for cell in cells
    }
    references = run_jobs(list(exact.values()), options)
    wanted = [
        (cell.place, LEARNED[group]) for cell in cells for group in groups if group in LEARNED
    ]
    files = trained.files(wanted, options)
    todo = [
        Job(f"{cell.name}-{group}", measured.measure, (cell, group), (*exact[cell].beside, file))
        for cell in cells
        if references[exact[cell].name] is not None
        for group in groups
        for file in [files.get((cell.place, LEARNED[group])) if group in LEARNED else ""]
        if file is not None
    ]
    done = run_jobs(todo, options)
    return [row for job in todo for row in done[job.name] or []]


def _of_skin(options: Options) -> str:
    """The end of a file's name: rows of another skin stand beside those of the rings."""
    (layout,) = options.layouts
    return f"_{layout_name(layout)}" if layout else ""
