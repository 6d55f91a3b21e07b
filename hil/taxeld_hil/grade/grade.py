"""The grade of a session: checks that pass, fail or could not be made, and the figures behind them.

It is read from the session's files alone, whether a run has made them or a daemon on hardware.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.estimator.estimate import Status
from taxeld.model.scene import Scene
from taxeld.model.symmetry import add_m
from taxeld.pipeline.freshness import Why
from taxeld.source.session import truth as true_pose
from taxeld.stream.messages import STAGES
from taxeld_hil.grade import session
from taxeld_hil.grade.flags import signs
from taxeld_hil.grade.reconcile import laws
from taxeld_hil.grade.recording import replayed
from taxeld_hil.grade.session import POSE, Reception, Run
from taxeld_hil.rules import MARKS
from taxeld_hil.scenario.scenario import Expect
from taxeld_hil.scenario.staged import load_model
from taxeld_sim import integrity

GRADE = "grade.json"
PERCENTILES = {"p50": 50, "p90": 90, "p99": 99, "max": 100}
EPISODES_KEPT = 100
LONG_S, GROWTH_MAX_MB = 120.0, 8.0  # of a run whose daemon's memory is graded, and by how much
UNKNOWN = "not graded: the true pose is not known"


class Check(NamedTuple):
    """One thing that was expected."""

    name: str
    passed: bool | None  # None: it could not be checked
    detail: str

    def __str__(self) -> str:
        return f"{MARKS[self.passed]:<4}  {self.name}: {self.detail}"


@dataclass(frozen=True, slots=True)
class Grade:
    """All that is known of a run when it has ended."""

    run: Run
    checks: tuple[Check, ...]
    figures: dict[str, Any]

    @property
    def failed(self) -> list[str]:
        """The names of the checks that failed."""
        return [check.name for check in self.checks if check.passed is False]

    @property
    def passed(self) -> bool:
        return not self.failed

    def write(self, directory: Path) -> None:
        """Write grade.json."""
        run = {name: getattr(self.run, name) for name in ("seed", "clock")}
        about = {"scenario": self.run.name, **run, "transport": self.run.scenario.transport}
        checks = [check._asdict() for check in self.checks]
        made = {**about, "passed": self.passed, "checks": checks, **self.figures}
        (directory / GRADE).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def grade(directory: Path, truth: Poses | None = None) -> Grade:
    """The grade of a session: of one that a run has left by what was published, of any other by its
    replay. `truth` (3,): of the object, where the session does not have it.

    Raises:
        SetupError: a file is missing or damaged, or the scenario's bundle cannot be loaded.
    """
    if (directory / session.RUN).exists():
        run = session.read_run(directory)
        got, scene = session.read(directory, run.scenario.links), None
    else:
        run, got, scene = replayed(directory)
    if truth is None:
        truth = true_pose(directory)
    figures = _figures(got)
    if truth is not None:
        figures |= _truth(run, got, scene or load_model(run.scenario.of_link(0)).scene, truth)
    health = got.health[-1][1] if got.health else {}
    line = run.scenario.transport == "native"
    held = [] if run.ledger is None else laws(run.ledger, health, line=line)
    figures["faults"] = signs(run, got)
    figures["laws"] = [{**law._asdict(), "holds": law.holds} for law in held]
    figures["ledger"] = run.ledger or {}
    checks = [
        *_found(run, got, figures["error_mm"], truth is None),
        _misleading(figures),
        *(check for each in figures["faults"] for check in _of_fault(each, run.scenario.expect)),
        *(Check(f"accounts: {law.name}", law.holds, law.text) for law in held),
    ]
    if run.ledger is None:
        checks.append(Check("accounts", None, "not graded: only a virtual skin keeps a ledger"))
    if run.clock == "real" and run.end_s >= LONG_S:
        text = f"grew by {run.growth_mb:+.1f} MB, under {GROWTH_MAX_MB:g} MB is asked"
        checks.append(Check("memory", run.growth_mb < GROWTH_MAX_MB, text))
    return Grade(run, tuple(checks), figures)


def _figures(got: Reception) -> dict[str, Any]:
    """What needs no truth."""
    e = got.estimates
    first = e[(e.t != 0.0) & (np.diff(e.t, prepend=0.0) != 0.0)]  # of each scan
    ticks = e[e.skin > 0.0]
    return {
        "status": Status(e.status[-1]).name.lower() if len(e) else "none",
        "contacts": int(e.contacts[-1:].sum()),
        "estimates": len(e),
        "valid": int((e.why == Why.VALID).sum()),
        "age_ms": _percentiles(1e-3 * first.age_us),
        "latency_ms": {stage: _percentiles(1e-3 * ticks[stage]) for stage in STAGES},
        "error_mm": None,
    }


def _truth(run: Run, got: Reception, scene: Scene, truth: Poses) -> dict[str, Any]:
    """The error at the end, and what misleads."""
    e, known = got.estimates, run.scenario.known
    number = known.index(run.scenario.bundle) if run.scenario.bundle in known else -1
    claimed = np.where(e.why == Why.VALID, e.p, 0.0)
    is_sure = integrity.is_sure(claimed)
    asked = is_sure.copy()
    asked[-1:] = True
    error_mm = np.full(len(e), np.nan)
    each, index = np.unique(e[[*POSE]][asked], return_inverse=True)
    errors_mm = [1e3 * add_m(scene, np.array(one.tolist()), truth)[1] for one in each]
    error_mm[asked] = np.array(errors_mm)[index]
    of_its_object = np.where(e.object == number, error_mm, np.nan)
    misled = is_sure & integrity.is_misleading(claimed, of_its_object, 1e3 * e.radius_m)
    begins = e.at[np.diff(misled, prepend=False) & misled]
    is_valid = (e.why[-1:] == Why.VALID).any()
    return {
        "error_mm": float(error_mm[-1]) if is_valid else None,  # symmetry-aware, of the last
        "sure": int(is_sure.sum()),
        "misleading": {
            "estimates": int(misled.sum()),
            "episodes": len(begins),  # uninterrupted sequences of misleading estimates
            "worst_mm": float(error_mm[misled].max(initial=0.0)),
            "at_s": begins[:EPISODES_KEPT].tolist(),
        },
    }


def _percentiles(values: Floats) -> dict[str, float]:
    found = np.percentile(values if len(values) else [0.0], [*PERCENTILES.values()])
    return dict(zip(PERCENTILES, found.tolist(), strict=True))


def _found(run: Run, got: Reception, error_mm: float | None, is_unknown: bool) -> Iterator[Check]:
    expect, known = run.scenario.expect, run.scenario.known
    state, is_found = "no estimate came", False
    if len(got.estimates):
        last = got.estimates[-1]
        status, why = Status(last.status), Why(last.why)
        state = f"status {status.name.lower()}"
        state += "" if why is Why.VALID else f", not valid: {why.name.lower()}"
        is_found = why is Why.VALID and status is Status.CONVERGED
    if not expect.found:
        yield Check("object found", None, f"not asked for; {state}")
        return
    if len(known) > 1 and len(got.estimates):
        name = known[int(last.object)]
        yield Check("which object", name == run.scenario.bundle, name)
    yield Check("object found", is_found, state)
    if is_unknown:
        yield Check("accuracy", None, UNKNOWN)
        return
    text = "no valid estimate" if error_mm is None else f"{error_mm:.2f} mm off"
    near = error_mm is not None and error_mm < expect.error_mm
    yield Check("accuracy", near, f"{text}, under {expect.error_mm:g} mm is asked")


def _misleading(figures: dict[str, Any]) -> Check:
    if "misleading" not in figures:
        return Check("nothing misleading", None, UNKNOWN)
    number, worst_mm = (figures["misleading"][key] for key in ("estimates", "worst_mm"))
    text = f"{number} of {figures['sure']} sure estimates"
    text += f", {worst_mm:.1f} mm off at worst" if number else ""
    return Check("nothing misleading", not number, text)


def _of_fault(seen: dict[str, Any], expect: Expect) -> Iterator[Check]:
    name = f"{seen['kind']} at {seen['at_s']:g} s"
    if not seen["injected"]:
        yield Check(f"{name}: flag", None, "not injected: not possible over this transport")
        return
    if seen["flag"] is not None:
        when, soon = seen["detected_s"], seen["within_s"]
        text = "never" if when is None else f"after {when:.2f} s"
        text += f", within {soon:g} s is asked: {seen['flag']}"
        yield Check(f"{name}: flag", when is not None and when <= soon, text)
    name, when = f"{name}: recovery", seen["recovered_s"]
    if when is not None:
        text = f"{when:.2f} s after its end, within {expect.recovery_s:g} s is asked"
        yield Check(name, when <= expect.recovery_s, text)
    elif seen["overlapped"]:
        yield Check(name, None, "not graded: another fault was on, or began before")
    else:
        why = ": inconsistent or blind" if seen["doubted"] else ""
        yield Check(name, False, f"no usable estimate in time{why}")


def lines(graded: Grade) -> Iterator[str]:
    """The report: laws that hold are one line."""
    run, figures = graded.run, graded.figures
    if run.clock == "real":
        yield "latency [ms]   median     p99     max"
        for stage, of in figures["latency_ms"].items():
            yield f"{stage:12s} {of['p50']:8.2f} {of['p99']:7.2f} {of['max']:7.2f}"
    if (error_mm := figures["error_mm"]) is not None:
        yield f"final error {error_mm:.1f} mm (mean distance of its points, up to its symmetry)"
    elif "sure" in figures:
        yield "final error unknown: the last estimate is not valid"
    is_played = run.ledger is not None
    how = f"over {run.scenario.transport}, {run.clock} clock" if is_played else run.clock
    yield f"{run.name}, seed {run.seed}, {how}"
    held = [check for check in graded.checks if check.name.startswith("accounts: ")]
    yield from (str(check) for check in graded.checks if check not in held or not check.passed)
    if held and all(check.passed for check in held):
        sent = figures["ledger"]["fates"]["units"]
        yield str(Check("accounts", True, f"{len(held)} laws hold over {sent} frames"))
    if run.clock == "real":
        age_ms = ", ".join(f"{key} {value:.2f}" for key, value in figures["age_ms"].items())
        yield f"      scan to estimate [ms]: {age_ms}"
    if done := figures["ledger"].get("done", {}):
        yield "      injected: " + ", ".join(f"{kind} {n}" for kind, n in done.items())
    failed = len(graded.failed)
    yield "passed" if graded.passed else f"failed: {failed} of {len(graded.checks)} checks"
