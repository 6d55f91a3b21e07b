"""The acceptance report: a page of text that a person can act on, and the same as JSON."""

import json
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.source import module_order
from taxeld_hil.acceptance.readings import IdleReadings
from taxeld_hil.acceptance.values import CheckResult, Received, Verdict

WIDTH = 100
INDENT = " " * 6
VERSION = 1


@dataclass(frozen=True, slots=True)
class Report:
    """What an acceptance run found."""

    target: str
    when: str
    received: Received
    readings: IdleReadings
    checks: Sequence[CheckResult]

    @property
    def seconds(self) -> float:
        """How long the untouched skin was read."""
        start, end = self.received.span
        return round(end - start, 3)

    @property
    def passed(self) -> bool:
        return not any(check.verdict is Verdict.FAILED for check in self.checks)

    @property
    def text(self) -> str:
        """The page."""
        layout = self.received.layout
        failed = sum(check.verdict is Verdict.FAILED for check in self.checks)
        verdict = "PASSED" if self.passed else f"FAILED, {failed} of {len(self.checks)} checks"
        lines = [
            f"skin acceptance: {verdict}",
            f"target {self.target}, {self.when}, {self.seconds:.0f} s untouched",
            f"layout {layout.name}: {len(layout)} taxels on {len(self.received.serials)} modules",
            "",
        ]
        for check in self.checks:
            lines += _lines(check)
        return "\n".join(lines) + "\n"

    @property
    def modules(self) -> str:
        """The hubs' modules in their order, as `source.modules`; empty where not all are known."""
        tables = self.received.tables
        told = all(m.sui is not None for table in tables.values() for m in table if m.channels)
        return module_order.text(tables) if tables and told else ""

    @property
    def json(self) -> str:
        """The same for machines, with a row for each taxel."""
        layout, got = self.received.layout, self.readings
        peak = strongest(self.received)
        rows = [
            {
                "uid": int(layout.uid[i]),
                "level": _number(got.level[i]),
                "noise": _number(got.noise[i]),
                "zero_share": _number(got.zero[i]),
                "saturated_share": _number(got.saturated[i]),
                "press_counts": None if peak is None else _number(peak[i]),
            }
            for i in range(len(layout))
        ]
        value = {
            "v": VERSION,
            "passed": self.passed,
            "target": self.target,
            "when": self.when,
            "seconds": self.seconds,
            "layout": {"name": layout.name, "digest": layout.digest},
            "period_ms": self.received.period_ms,
            "full_scale_counts": self.received.full_scale_counts,
            "checks": [_map(check) for check in self.checks],
            "taxels": rows,
        }
        return json.dumps(value, indent=1) + "\n"


def strongest(received: Received) -> Floats | None:
    """Most counts over idle that each taxel (M,) read in any press; None without presses."""
    if not received.presses:
        return None
    return np.asarray(np.max([press.peak for press in received.presses], axis=0))


def _lines(check: CheckResult) -> list[str]:
    head = f"{check.name:<13}{check.verdict.value:<13}"
    lines = _wrapped(check.summary, head, " " * len(head))
    for finding in check.findings:
        lines += _wrapped(f"{finding.where}: {finding.what}", INDENT + "✗ ", INDENT + "  ")
        lines += _wrapped(finding.cure, INDENT + "  → ", INDENT + "    ")
    for note in check.notes:
        lines += _wrapped(f"note: {note}", INDENT, INDENT + "  ")
    return lines


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    return textwrap.wrap(
        text, WIDTH, initial_indent=first, subsequent_indent=rest, break_on_hyphens=False
    )


def _map(check: CheckResult) -> dict[str, Any]:
    return {
        "name": check.name,
        "verdict": check.verdict.name.lower(),
        "summary": check.summary,
        "findings": [finding._asdict() for finding in check.findings],
        "notes": list(check.notes),
        "figures": dict(check.figures),
    }


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
