"""The acceptance report: a page of text that a person can act on, and the same as JSON."""

import json
import textwrap
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from taxeld.source.modules import text
from taxeld_hil.acceptance.checks import CHECKS, CheckResult
from taxeld_hil.acceptance.received import Received

WIDTH = 100
INDENT = " " * 6
VERSION = 1


@dataclass(frozen=True)
class AcceptanceReport:
    """The results of an acceptance run."""

    target: str
    when: str
    received: Received

    @cached_property
    def checks(self) -> dict[str, CheckResult]:
        """The outcome of each check, by its name."""
        return {name: check(self.received) for name, check in CHECKS.items()}

    @property
    def failed(self) -> list[str]:
        """Names of the checks that failed."""
        return [name for name, check in self.checks.items() if check.verdict == "failed"]

    @property
    def seconds(self) -> float:
        """Time that the untouched skin was read [s]."""
        start, end = self.received.span
        return round(end - start, 3)

    @property
    def text(self) -> str:
        """The page."""
        got, total = self.received, len(self.checks)
        modules = len({*(got.layout.uid >> 4).tolist()})
        verdict = f"FAILED, {len(self.failed)} of {total} checks" if self.failed else "PASSED"
        lines = [
            f"skin acceptance: {verdict}",
            f"target {self.target}, {self.when}, {self.seconds:.0f} s untouched",
            f"layout {got.layout.name}: {len(got.layout)} taxels on {modules} modules",
            "",
        ]
        for name, check in self.checks.items():
            head = f"{name:<13}{check.verdict.replace('failed', 'FAILED'):<13}"
            lines += _wrapped(check.summary, head, " " * len(head))
            for where, what, cure in check.findings:
                lines += _wrapped(f"{where}: {what}", INDENT + "✗ ", INDENT + "  ")
                lines += _wrapped(cure, INDENT + "  → ", INDENT + "    ")
            for note in check.notes:
                lines += _wrapped(f"note: {note}", INDENT, INDENT + "  ")
        return "\n".join(lines) + "\n"

    @property
    def modules(self) -> str:
        """The hubs' modules in their order, as `source.modules`; empty where not all are known."""
        tables = self.received.tables
        modules = [m for table in tables.values() for m in table if m.channels]
        known = all(m.sui is not None and not m.fault for m in modules)
        return text(tables) if tables and known else ""

    @property
    def json(self) -> str:
        """The report for machines, with a row for each taxel."""
        got, idle = self.received, self.received.idle
        none = np.full(len(got.layout), np.nan)
        columns = {
            "level": idle.level,
            "noise": idle.noise,
            "zero_share": idle.zero,
            "saturated_share": idle.saturated,
            "press_counts": none if got.peak is None else got.peak,
        }
        value = {
            "v": VERSION,
            "passed": not self.failed,
            "target": self.target,
            "when": self.when,
            "seconds": self.seconds,
            "layout": {"name": got.layout.name, "digest": got.layout.digest},
            "period_ms": got.period_ms,
            "full_scale_counts": got.full_scale_counts,
            "checks": [
                {
                    "name": name,
                    "verdict": check.verdict.replace(" ", "_"),
                    "summary": check.summary,
                    "findings": [finding._asdict() for finding in check.findings],
                    "notes": check.notes,
                    "figures": check.figures,
                }
                for name, check in self.checks.items()
            ],
            "taxels": [
                {"uid": int(uid)} | {name: _number(column[i]) for name, column in columns.items()}
                for i, uid in enumerate(got.layout.uid)
            ],
        }
        return json.dumps(value, indent=1) + "\n"


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
