"""`taxeld-hil expect`: how well an object will be found with a skin, touch by touch.

Touches go around the object. What is noted of each comes shortly after its end: whether the
object is *found*, and the estimate *sure* or *misleading*, as in `integrity`.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from taxeld.estimator.estimate import Estimate
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld.proposals.analytic import Table
from taxeld_hil.experiment.expect_subjects import known_responses
from taxeld_hil.experiment.measurement import RunRow, digest
from taxeld_hil.integrity import Claims
from taxeld_hil.jobs import Job
from taxeld_hil.rig.rig import IDLE_S
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.bundled import on_layout

RATE_HZ = 40.0
HOLD_S = 0.7  # how long a press is held
SEEN_S = 0.4  # after the end of a touch, by when the daemon has learned from it
KEYS = "p", "radius_mm", "error_mm"  # of what is noted of a touch
AS_IS, BY_TABLE, CALIBRATED = "as it is", "as it is, by table", "calibration"
TABLE = 'proposal = "table"'
HALF = 0.5  # share of trials that are sure, at which what would help is compared
LEAST = 8  # seeds of which something is said
CHANCE = 2.0  # standard errors that chance alone may make


class Touched(NamedTuple):
    """A row of the table: all trials after so many touches."""

    touches: int
    trials: int
    median_mm: float
    p90_mm: float
    found: float  # shares of the trials
    found_and_sure: float
    misleading: float


class Help(NamedTuple):
    """What a change does to the trials of the same seeds."""

    name: str
    trials: int
    after: int  # touches
    found: tuple[float, float]  # without and with it
    found_and_sure: tuple[float, float]
    verdict: str  # by the trials that are found and sure, against chance


def jobs(subjects: dict[str, Scenario], seeds: int, touches: int) -> list[Job]:
    """A job for each trial, seed by seed, so that a part of them is as fair as all. Every other
    seed also tries what would help; all of that by the same proposal, looked-up contacts."""
    own = subjects[AS_IS]
    by_table = on_layout(own.bundle, own.skin_layout).order == (Table.name,)
    changed = {} if by_table else {BY_TABLE: own}
    changed |= {CALIBRATED: own} | {k: v for k, v in subjects.items() if k != AS_IS}
    found = []
    for seed in range(seeds):
        todo = {AS_IS: own} | (changed if seed % 2 == 0 else {})
        for name, subject in todo.items():
            keys = "" if name == AS_IS else TABLE
            arguments = (name, subject, seed, touches, keys)
            found.append(Job(f"{name}, seed {seed}", play, arguments, code=digest(subject)))
    return found


def play(name: str, subject: Scenario, seed: int, touches: int, keys: str) -> RunRow:
    """One trial, as JSON has it; `keys`: of the daemon's table [filter]."""
    calibration = known_responses(subject, seed) if name == CALIBRATED else None
    subject = replace(subject, contacts=touches, hold_s=HOLD_S)
    run = FakeRun(subject, seed, RATE_HZ, keys, calibration)
    notes = IDLE_S + run.rig.path.touched[:, 1] + SEEN_S
    after: list[dict[str, Any]] = []
    for k in range(math.ceil(notes[-1] * RATE_HZ) + 1):
        e = run.step(k / RATE_HZ)
        if k / RATE_HZ >= notes[len(after)]:
            after.append(_noted(run, e))
    return {"name": name, "seed": seed, "after": after}


def _noted(run: FakeRun, e: Estimate | None) -> dict[str, Any]:
    assert e is not None  # noqa: S101  (there is an estimate after each tick)
    assert run.daemon is not None  # noqa: S101
    error_m = add_m(run.rig.model.scene, e.map, run.rig.world.truth)[1]
    is_valid = run.daemon.pipeline.freshness.why(e, run.line.now) is Why.VALID
    return {
        "error_mm": round(1e3 * error_m, 3),
        "p": round(e.p if is_valid else 0.0, 4),
        "radius_mm": round(1e3 * e.radius_m, 3),
    }


def claims(runs: Sequence[RunRow]) -> Claims:
    """The estimates of N trials after T touches each (N, T)."""
    noted = [[[each[key] for key in KEYS] for each in run["after"]] for run in runs]
    return Claims(*np.moveaxis(np.array(noted), -1, 0))


def described(run: RunRow) -> str:
    """A trial's errors in short."""
    errors = ", ".join(f"{noted['error_mm']:.1f}" for noted in run["after"])
    return f"{errors} mm{', found and sure' * bool(claims([run]).found_and_sure[0, -1])}"


def table(runs: Sequence[RunRow]) -> list[Touched]:
    """A row for each number of touches."""
    of = claims(runs)
    median, p90 = np.quantile(of.error_mm, (0.5, 0.9), axis=0).tolist()
    shares = (rule.mean(axis=0).tolist() for rule in (of.found, of.found_and_sure, of.misleading))
    return [
        Touched(k, len(runs), *row)
        for k, row in enumerate(zip(median, p90, *shares, strict=True), 1)
    ]


def helps(runs: Sequence[RunRow]) -> list[Help]:
    """What each change does, by trials of the same seeds, most helpful first. Shares are those
    after the first touch after which half of the trials are sure without it, or the last."""
    names = dict.fromkeys(run["name"] for run in runs)
    base = {run["seed"]: run for run in runs if run["name"] == AS_IS}
    if BY_TABLE in names:
        base = {run["seed"]: run for run in runs if run["name"] == BY_TABLE}
    if not base:
        return []
    rows = table(list(base.values()))
    after = next((row.touches for row in rows if row.found_and_sure >= HALF), rows[-1].touches)
    found = []
    for name in [name for name in names if name not in (AS_IS, BY_TABLE)]:
        mine = [run for run in runs if run["name"] == name and run["seed"] in base]
        pairs = [(base[run["seed"]], run) for run in mine]
        if pairs:
            found.append(_help(name, after, pairs))
    return sorted(found, key=lambda each: each.found_and_sure[0] - each.found_and_sure[1])


def _help(name: str, after: int, pairs: Sequence[tuple[RunRow, RunRow]]) -> Help:
    each = [claims([pair[k] for pair in pairs]) for k in (0, 1)]
    found, sure = (
        np.column_stack([getattr(of, rule)[:, after - 1] for of in each]).astype(float)
        for rule in ("found", "found_and_sure")
    )  # (n, 2)
    gain = sure[:, 1] - sure[:, 0]
    least = CHANCE * math.sqrt((gain.var() + 1.0 / len(gain)) / len(gain))
    verdict = "no difference seen"
    if len(gain) < LEAST:
        verdict = "too few seeds to tell"
    elif abs(gain.mean()) > least:
        verdict = "would help" if gain.mean() > 0.0 else "would hurt"
    was, became = (tuple(each.mean(axis=0).tolist()) for each in (found, sure))
    return Help(name, len(pairs), after, was, became, verdict)
