"""A grade for people (lines of text) and for programs (grade.json)."""

import json
from collections.abc import Iterator
from pathlib import Path

from taxeld_hil.grade.grade import Check, Grade

GRADE = "grade.json"
MARKS = {True: "ok  ", False: "FAIL", None: "-   "}


def lines(grade: Grade) -> Iterator[str]:
    """The report: laws that hold are one line."""
    run, figures = grade.run, grade.figures
    yield (
        f"{run.scenario}, seed {run.seed}, on {run.target} over {run.transport}, {run.clock} clock"
    )
    laws = [check for check in grade.checks if check.name.startswith("accounts: ")]
    for check in grade.checks:
        if check not in laws or not check.passed:
            yield _line(check)
    if laws and all(check.passed for check in laws):
        sent = figures["ledger"]["fates"]["units"]
        detail = f"{len(laws)} laws hold over {sent} frames"
        yield _line(Check("accounts", True, detail))
    for name, what in (("age_ms", "scan to estimate"), ("tick_ms", "tick with a scan")):
        if figures[name]["max"]:
            parts = ", ".join(f"{key} {value:.2f}" for key, value in figures[name].items())
            yield f"      {what} [ms]: {parts}"
    done = figures["ledger"].get("done", {}) if figures["ledger"] else {}
    if done:
        yield "      injected: " + ", ".join(f"{kind} {n}" for kind, n in done.items())
    failed = sum(check.passed is False for check in grade.checks)
    yield "passed" if grade.passed else f"failed: {failed} of {len(grade.checks)} checks"


def write(grade: Grade, directory: Path) -> None:
    """Write grade.json."""
    directory.mkdir(parents=True, exist_ok=True)
    text = json.dumps(grade.as_json(), indent=1)
    (directory / GRADE).write_text(text + "\n", encoding="utf-8")


def _line(check: Check) -> str:
    return f"{MARKS[check.passed]}  {check.name}: {check.detail}"
