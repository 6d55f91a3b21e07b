"""`taxeld-hil touches`: how well an object is found by ten touches of a soft skin."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict

import numpy as np

from taxeld.errors import SetupError
from taxeld_hil.experiment import touch_runs
from taxeld_hil.experiment.measurement import Run, digest, require
from taxeld_hil.experiment.overlooked import OVERLOOKED_NATS
from taxeld_hil.experiment.touch_runs import AFTER, FOUND_MM
from taxeld_hil.jobs import Job
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario

CLOSE_MM = 5.0


def jobs(objects: Sequence[str], skins: Sequence[str], seeds: int) -> list[Job]:
    """A job for each run with bundles and skins, seed by seed.

    Raises:
        SetupError: there is no such object or skin, an object has no mesh here, or there are no
            seeds.
    """
    demo = scenario.load("demo")
    for skin in skins:
        if demo.on(skin).physics == "scene":
            raise SetupError("--skin scene: is no soft skin; name typical, poor or stiff")
    require(objects, skins, seeds)
    subjects = [demo.touching(name).on(skin) for skin in skins for name in objects]
    return [
        Job(f"{s.bundle}, {s.physics}, seed {seed}", play, (s, seed, digest(s)))
        for seed in range(seeds)
        for s in subjects
    ]


def play(subject: Scenario, seed: int, code: str) -> Run:
    """One run; `code` is part of the job's key alone."""
    del code
    return asdict(touch_runs.play(subject, seed))


def described(run: Run) -> str:
    """A run's errors, in short."""
    return f"{run['error_mm']} mm after {AFTER}"


def lines(runs: Sequence[Run]) -> Iterator[str]:
    """Errors and failures as a Markdown table: a row a skin and object."""
    head = [
        "skin, object",
        *(f"median (p90) mm, < 5 mm after {n}" for n in AFTER),
        *(f"not found after {n}, overlooked" for n in AFTER[-2:]),
        "felt in the air",
        "light ones missed",
        "silent",
    ]
    yield "| " + " | ".join(head) + " |"
    yield "|---" * len(head) + "|"
    for skin, name in dict.fromkeys((run["skin"], run["object"]) for run in runs):
        mine = [run for run in runs if (run["skin"], run["object"]) == (skin, name)]
        errors = np.array([run["error_mm"] for run in mine])  # (runs, len(AFTER))
        nats = np.array([run["truth_nats"] for run in mine], dtype=float)  # nan: found
        lost = (errors >= FOUND_MM).sum(axis=0)
        overlooked = (nats > OVERLOOKED_NATS).sum(axis=0)
        scans, felt, light, missed = (
            sum(run[key] for run in mine) for key in ("scans", "felt_in_air", "light", "missed")
        )
        cells = [
            f"{skin}, {name}",
            *map(_errors, errors.T),
            *(f"{lost[k]}, {overlooked[k]}" for k in (-2, -1)),
            f"{felt / scans:.1%}",
            f"{missed / light:.0%} of {light}",
            f"{np.mean([run['silent_episodes'] > 0 for run in mine]):.1%}",
        ]
        yield "| " + " | ".join(cells) + " |"


def _errors(error_mm: Sequence[float]) -> str:
    """Of runs: the median, the 90th percentile, and the share that is close."""
    error = np.asarray(error_mm)
    median, p90 = (
        f"{value:.0f}" if value >= 100.0 else f"{value:.3g}"
        for value in np.quantile(error, (0.5, 0.9))
    )
    return f"{median} ({p90}), {np.mean(error < CLOSE_MM):.0%}"
