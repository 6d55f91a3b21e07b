"""The grade of a run: checks that pass, fail or could not be made, and the figures behind them."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from taxeld.estimator.estimate import Status
from taxeld_hil.grade.judge import AGE_UNIT_S, Judge, Seen, percentile
from taxeld_hil.grade.reconcile import Law
from taxeld_hil.rig.ledger import Ledger
from taxeld_hil.scenario.scenario import Expect

PERCENTILES = {"p50": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that was expected."""

    name: str
    passed: bool | None  # None: it could not be checked
    detail: str


@dataclass(frozen=True, slots=True)
class Run:
    """Which run it was."""

    scenario: str
    seed: int
    target: str  # sim, or the device
    clock: str  # fake, real
    transport: str


@dataclass(frozen=True, slots=True)
class Grade:
    """All that is known of a run when it has ended."""

    run: Run
    checks: tuple[Check, ...]
    figures: dict[str, Any]

    @property
    def passed(self) -> bool:
        return all(check.passed is not False for check in self.checks)

    def as_json(self) -> dict[str, Any]:
        checks = [asdict(check) for check in self.checks]
        return {**asdict(self.run), "passed": self.passed, "checks": checks, **self.figures}


def grade(run: Run, judge: Judge, laws: list[Law], ledger: Ledger | None) -> Grade:
    """`laws` and `ledger` are of a virtual skin; a real one has none."""
    expect = judge.scenario.expect
    checks = [
        *_found(judge, expect),
        _misleading(judge),
        *(check for seen in judge.seen for check in _fault(seen, expect)),
        *_accounts(laws, ledger),
    ]
    figures = {
        "error_mm": _error_mm(judge),
        "status": judge.last.status.name.lower() if judge.last else "none",
        "contacts": judge.last.contacts if judge.last else 0,
        "estimates": judge.tally.estimates,
        "valid": judge.tally.valid,
        "sure": judge.tally.sure,
        "misleading": {
            "estimates": judge.tally.misleading,
            "episodes": judge.tally.misleading_episodes,
            "worst_mm": judge.tally.worst_misleading_mm,
            "at_s": judge.tally.misleading_at_s,
        },
        "age_ms": _percentiles(judge.tally.ages, 1e3 * AGE_UNIT_S),
        "tick_ms": _percentiles(judge.tally.ticks_us, 1e-3),
        "faults": [_fault_row(seen) for seen in judge.seen],
        "laws": [{**law._asdict(), "holds": law.holds} for law in laws],
        "ledger": ledger.entries() if ledger else {},
    }
    return Grade(run, tuple(checks), figures)


def _error_mm(judge: Judge) -> float | None:
    """None where there is no truth, or no estimate."""
    if judge.truth is None or judge.last is None or not judge.last.valid:
        return None
    return judge.error_mm(judge.last.map)


def _found(judge: Judge, expect: Expect) -> Iterator[Check]:
    last, error = judge.last, _error_mm(judge)
    converged = last is not None and last.valid and last.status == Status.CONVERGED
    state = "no estimate came" if last is None else f"status {last.status.name.lower()}"
    state += f", not valid: {last.why.name.lower()}" if last and not last.valid else ""
    known = judge.scenario.known
    if len(known) > 1 and last is not None and expect.found:
        yield Check("which object", last.object == judge.object, known[last.object])
    if not expect.found:
        yield Check("object found", None, f"not asked for; {state}")
    else:
        yield Check("object found", converged, state)
        if judge.truth is None:
            yield Check("accuracy", None, "not graded: the true pose is not known")
        else:
            near = error is not None and error < expect.error_mm
            text = "no valid estimate" if error is None else f"{error:.2f} mm off"
            yield Check("accuracy", near, f"{text}, under {expect.error_mm:g} mm is asked")


def _misleading(judge: Judge) -> Check:
    tally, name = judge.tally, "nothing misleading"
    if judge.truth is None:
        return Check(name, None, "not graded: the true pose is not known")
    worst = f", {tally.worst_misleading_mm:.1f} mm off at worst" if tally.misleading else ""
    text = f"{tally.misleading} of {tally.sure} sure estimates{worst}"
    return Check(name, not tally.misleading, text)


def _fault(seen: Seen, expect: Expect) -> Iterator[Check]:
    fault, flag = seen.fault, seen.flag
    name = f"{fault.kind} at {fault.at_s:g} s"
    if not seen.injected:
        yield Check(f"{name}: flag", None, "not injected: not possible on this target")
        return
    if flag is not None:
        when, soon = seen.detected_s, flag.within_s
        text = "never" if when is None else f"after {when:.2f} s"
        in_time = when is not None and when <= soon
        yield Check(f"{name}: flag", in_time, f"{text}, within {soon:g} s is asked: {flag.text}")
    name = f"{name}: recovery"
    if seen.recovered_s is not None:
        good = seen.recovered_s <= expect.recovery_s
        asked = f"within {expect.recovery_s:g} s is asked"
        yield Check(name, good, f"{seen.recovered_s:.2f} s after its end, {asked}")
    elif seen.overlapped:
        yield Check(name, None, "not graded: another fault was on, or began before")
    else:
        why = ": inconsistent or blind" if seen.doubted else ""
        yield Check(name, False, f"no usable estimate in time{why}")


def _fault_row(seen: Seen) -> dict[str, Any]:
    fault, flag = seen.fault, seen.flag
    return {
        "kind": fault.kind,
        "at_s": fault.at_s,
        "for_s": fault.for_s,
        "injected": seen.injected,
        "flag": flag.text if flag else None,
        "within_s": flag.within_s if flag else None,
        "detected_s": seen.detected_s,
        "recovered_s": seen.recovered_s,
        "doubted": seen.doubted,
        "overlapped": seen.overlapped,
    }


def _accounts(laws: list[Law], ledger: Ledger | None) -> Iterator[Check]:
    if ledger is None:
        yield Check("accounts", None, "not graded: only a virtual skin keeps a ledger")
    for law in laws:
        text = f"{law.counted} counted, {law.expected} expected"
        slack = f" ± {law.slack}" if law.slack else ""
        yield Check(f"accounts: {law.name}", law.holds, text + slack)


def _percentiles(counts: Counter[int], unit: float) -> dict[str, float]:
    return {name: percentile(counts, share) * unit for name, share in PERCENTILES.items()}
