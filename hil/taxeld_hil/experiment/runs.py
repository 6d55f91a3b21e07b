"""Many runs as jobs, a row each: `taxeld-hil matrix` has scenarios on objects and skins, seed by
seed, and says how many find theirs."""

from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld_hil.integrity import is_found
from taxeld_hil.jobs import Job, layout_name
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.trials.case import digest
from taxeld_hil.world.subjects import Subject, solid_of
from taxeld_hil.world.world import load_model

RATE_HZ = 40.0  # ticks on the fake clock, where none is late

RunRow: TypeAlias = dict[str, Any]  # one run's figures, as JSON has them


def matrix(
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
    return [of(name, subject, seed) for seed, (name, subject) in product(range(seeds), subjects)]


def of(name: str, subject: Scenario, seed: int, *, real: bool = False) -> Job:
    """A run on the fake clock, or in real time."""
    bundle, skin, layout, _ = _about(subject, seed).values()
    words = ", ".join(filter(None, [name, bundle, skin, layout, f"seed {seed}"]))
    specs = filter(None, (subject.layout, *subject.layouts))
    code = digest(subject, map(Subject, (subject.bundle, *subject.bundles)), specs)
    return Job(words, play, (name, subject, seed, real), code=code)


def _about(subject: Scenario, seed: int) -> RunRow:
    layout = layout_name(subject.layout)  # empty: what the bundle was built for
    return {"bundle": subject.bundle, "skin": subject.physics, "layout": layout, "seed": seed}


def play(name: str, subject: Scenario, seed: int, real: bool) -> RunRow:
    """The figures of one run."""
    run = LiveRun(subject, seed) if real else FakeRun(subject, seed, RATE_HZ)
    grade = run.graded(Path(name).stem)
    figures, error_mm = grade.figures, grade.figures["error_mm"]
    return {
        "scenario": name,
        **_about(subject, seed),
        "passed": grade.passed,  # all checks
        "found": error_mm is not None and bool(is_found(error_mm)),
        "error_mm": None if error_mm is None else round(error_mm, 3),  # up to symmetry
        "status": figures["status"],
        "touches": subject.contacts,
        "contacts": figures["contacts"],  # counted by the daemon
        "misleading_at_s": figures["misleading"]["at_s"],  # begins of episodes
        "faults": figures["faults"],
        "failed": grade.failed,
        "seconds": grade.run.end_s,
        "growth_mb": grade.run.growth_mb,
    }


def described(run: RunRow) -> str:
    """A run's figures in short."""
    error = "no estimate" if run["error_mm"] is None else f"{run['error_mm']:.1f} mm"
    failed = f"; failed: {', '.join(run['failed'])}" if run["failed"] else ""
    return f"{run['status']}, {error}{failed}"


def is_sure(run: RunRow) -> bool:
    """Whether the object was found, and the daemon sure of it, at the end."""
    return bool(run["found"] and run["status"] == "converged")


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
    sure = list(filter(is_sure, runs))
    failed = sum(not run["passed"] for run in sure)
    misled = sum(bool(run["misleading_at_s"]) for run in runs)
    text = f"{len(sure)} of {len(runs)}" + f", {failed} failed" * bool(failed)
    return text + f", {misled} misleading" * bool(misled)
