"""`taxeld-hil matrix`: scenarios on objects and skins, seed by seed, a row a run."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

from taxeld.errors import SetupError
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import random_faults, scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.scenario.staged import load_model
from taxeld_sim import jobs
from taxeld_sim.integrity import is_found
from taxeld_sim.jobs import Job, layout_name
from taxeld_sim.trials.case import digest
from taxeld_sim.world.subjects import Subject, solid_of

RATE_HZ = 40.0  # ticks on the fake clock, where none is late

RunRow: TypeAlias = dict[str, Any]  # one run's figures, as JSON has them


def matrix(
    scenarios: Sequence[str],
    objects: Sequence[str],
    skins: Sequence[str],
    seeds: int,
    layouts: Sequence[str],
    minutes: int = 0,
) -> list[Job]:
    """A job for each run of scenarios with bundles, skins and layouts, seed by seed, so that a part
    of them is as fair as all. `minutes`: of faults that the seed draws; 0: the scenario's own.

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
    found = []
    for seed, (name, own) in product(range(seeds), subjects):
        subject = random_faults.drawn(own, seed, minutes) if minutes else own
        found.append(of(name, subject, seed))
    return found


def of(name: str, subject: Scenario, seed: int) -> Job:
    """A run on the fake clock."""
    bundle, skin, layout, _ = _about(subject, seed).values()
    words = ", ".join(filter(None, [name, bundle, skin, layout, f"seed {seed}"]))
    specs = filter(None, (subject.layout, *subject.layouts))
    subjects = map(Subject, (subject.bundle, *subject.bundles))
    code = digest(subject, subjects, specs) + jobs.code(("taxeld_hil/**/*.py",))
    return Job(words, play, (name, subject, seed), code=code)


def _about(subject: Scenario, seed: int) -> RunRow:
    layout = layout_name(subject.layout)  # empty: what the bundle was built for
    return {"bundle": subject.bundle, "skin": subject.physics, "layout": layout, "seed": seed}


def play(name: str, subject: Scenario, seed: int) -> RunRow:
    """The figures of one run."""
    grade = FakeRun(subject, seed, RATE_HZ).graded(Path(name).stem)
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
    }


def described(run: RunRow) -> str:
    """A run's figures in short."""
    error = "no estimate" if run["error_mm"] is None else f"{run['error_mm']:.1f} mm"
    failed = f"; failed: {', '.join(run['failed'])}" if run["failed"] else ""
    return f"{run['status']}, {error}{failed}"
