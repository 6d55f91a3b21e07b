"""`taxeld-hil matrix`: scenarios on objects and skins, seed by seed, and how many find theirs."""

import tempfile
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

from taxeld_hil.experiment.measurement import RunRow, digest, require
from taxeld_hil.integrity import is_found
from taxeld_hil.jobs import Job, layout_name
from taxeld_hil.run.fake_run import NOT_INJECTED, FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario


def jobs(
    scenarios: Sequence[str],
    objects: Sequence[str],
    skins: Sequence[str],
    seeds: int,
    *,
    real: bool,
    layouts: Sequence[str] = ("",),
) -> list[Job]:
    """A job for each run of scenarios with bundles, skins and layouts, seed by seed, so that a part
    of them is as fair as all. With `real`, a scenario with a fault that no fake clock can inject
    runs in real time.

    Raises:
        SetupError: there is no such scenario, object or skin, an object has no mesh here, or there
            are no seeds.
    """
    require(objects, skins, seeds, layouts, soft=False)
    found = []
    for seed in range(seeds):
        for name in scenarios:
            asked = scenario.load(name)
            in_real_time = real and any(fault.kind in NOT_INJECTED for fault in asked.fault)
            for skin, bundle, layout in product(skins, objects, layouts):
                subject = asked.touching(bundle).on(skin, layout)
                words = [bundle, skin, *filter(None, [layout_name(layout)]), f"seed {seed}"]
                title = ", ".join([name, *words, *["real time"] * in_real_time])
                arguments = (name, subject, seed, in_real_time)
                found.append(Job(title, play, arguments, code=digest(subject)))
    return found


def play(name: str, subject: Scenario, seed: int, in_real_time: bool) -> RunRow:
    """The figures of one run."""
    stem = Path(name).stem
    if in_real_time:
        with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
            run = LiveRun(stem, subject, seed, Path(place) / "session", "", lambda _: None)
            grade = run.graded(Path(place))
    else:
        grade = FakeRun(subject, seed).graded(stem)
    figures, error_mm = grade.figures, grade.figures["error_mm"]
    return {
        "scenario": name,
        "bundle": subject.bundle,
        "skin": subject.physics,
        "layout": layout_name(subject.layout),  # empty: what the bundle was built for
        "seed": seed,
        "real": in_real_time,
        "passed": grade.passed,  # all checks
        "found": error_mm is not None and bool(is_found(error_mm)),
        "error_mm": None if error_mm is None else round(error_mm, 3),  # up to symmetry
        "status": figures["status"],
        "contacts": figures["contacts"],  # counted by the daemon
        "misleading": figures["misleading"]["episodes"],
        "stanford": figures["stanford"],
        "failed": [check.name for check in grade.checks if check.passed is False],
    }


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
    for layout in dict.fromkeys(run.get("layout", "") for run in runs):
        on = [[r for r in mine if r.get("layout", "") == layout] for mine in columns.values()]
        there = f", {layout}" if layout else ""
        for name in dict.fromkeys(run["scenario"] for run in runs):
            cells = [_cell([r for r in mine if r["scenario"] == name]) for mine in on]
            yield f"| {name}{there} | " + " | ".join(cells) + " |"
        yield f"| **all**{there} | " + " | ".join(map(_cell, on)) + " |"


def _cell(runs: Sequence[RunRow]) -> str:
    sure = [run for run in runs if run["found"] and run["status"] == "converged"]
    failed = sum(not run["passed"] for run in sure)
    misled = sum(run.get("misleading", 0) > 0 for run in runs)  # older runs were not asked
    text = f"{len(sure)} of {len(runs)}" + f", {failed} failed" * bool(failed)
    return text + f", {misled} misleading" * bool(misled)
