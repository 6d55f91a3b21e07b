"""`taxeld-hil matrix`: scenarios on objects and skins, seed by seed, and how many find theirs."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from taxeld.errors import SetupError
from taxeld_hil.experiment.measurement import RunRow, about, digest, row, title
from taxeld_hil.jobs import Job
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.subjects import Subject, solid_of
from taxeld_hil.world.world import load_model


def jobs(
    scenarios: Sequence[str],
    objects: Sequence[str],
    skins: Sequence[str],
    seeds: int,
    layouts: Sequence[str],
) -> list[Job]:
    """A job for each run of scenarios with bundles, skins and layouts, seed by seed, so that a part
    of them is as fair as all.

    Raises:
        SetupError: there is no such scenario, object or skin, an object has no mesh here, or there
            are no seeds.
    """
    if seeds < 1:
        raise SetupError("--seeds must be at least 1")
    subjects = [
        (name, scenario.load(name).touching(bundle).on(skin, layout))
        for name, skin, bundle, layout in product(scenarios, skins, objects, layouts)
    ]
    for _, subject in subjects:  # a mesh is built once, before several workers need it
        load_model(subject)
        if subject.physics != "scene":
            solid_of(Subject(subject.bundle), subject.skin_layout)
    return [
        Job(title(name, subject, seed), play, (name, subject, seed), code=digest(subject))
        for seed, (name, subject) in product(range(seeds), subjects)
    ]


def play(name: str, subject: Scenario, seed: int) -> RunRow:
    """The figures of one run."""
    graded = FakeRun(subject, seed).graded(Path(name).stem)
    return {"scenario": name, **about(subject, seed), **row(graded)}


def described(run: RunRow) -> str:
    """A run's figures in short."""
    error = "no estimate" if run["error_mm"] is None else f"{run['error_mm']:.1f} mm"
    failed = f"; failed: {', '.join(run['failed'])}" if run["failed"] else ""
    return f"{run['status']}, {error}{failed}"


def lines(runs: Sequence[RunRow]) -> Iterator[str]:
    """How often each scenario's object was found and sure at the end, as a Markdown table: a row a
    scenario and layout, a column a skin and object; with the runs in which a check failed all the
    same, and those with a misleading estimate."""
    columns: dict[str, list[RunRow]] = {}
    for run in runs:
        name = Path(run["bundle"]).name  # the directory's name of a bundle that is not shipped
        columns.setdefault(f"{run['skin']}, {name}", []).append(run)
    yield "| scenario | " + " | ".join(columns) + " |"
    yield "|---" * (len(columns) + 1) + "|"
    for layout in dict.fromkeys(run["layout"] for run in runs):
        on = [[r for r in mine if r["layout"] == layout] for mine in columns.values()]
        there = f", {layout}" if layout else ""
        for name in dict.fromkeys(run["scenario"] for run in runs):
            cells = [_cell([r for r in mine if r["scenario"] == name]) for mine in on]
            yield f"| {name}{there} | " + " | ".join(cells) + " |"
        yield f"| **all**{there} | " + " | ".join(map(_cell, on)) + " |"


def _cell(runs: Sequence[RunRow]) -> str:
    sure = [run for run in runs if run["found"] and run["status"] == "converged"]
    failed = sum(not run["passed"] for run in sure)
    misled = sum(bool(run["misleading_at_s"]) for run in runs)
    text = f"{len(sure)} of {len(runs)}" + f", {failed} failed" * bool(failed)
    return text + f", {misled} misleading" * bool(misled)
