"""`taxeld-hil soak --table`: reports of soaks side by side, as docs/harness.md shows them."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from taxeld.errors import SetupError
from taxeld_hil.scenario import laps

Report = dict[str, Any]


def lines(paths: list[Path]) -> Iterator[str]:
    """A Markdown table, a column a report.

    Raises:
        SetupError: a file is no report of a soak.
    """
    reports = [_read(path) for path in paths]
    yield "| | " + " | ".join(f"[{path.stem}](results/{path.name})" for path in paths) + " |"
    yield "|---" * (len(paths) + 1) + "|"
    for name, cell in ROWS.items():
        try:
            cells = [cell(report) for report in reports]
        except (KeyError, TypeError, ValueError):
            raise SetupError(f"{name}: a report is of an older kind; make it again") from None
        yield f"| {name} | " + " | ".join(cells) + " |"


def _read(path: Path) -> Report:
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
        report["laps"], report["object"]
    except OSError as error:
        raise SetupError(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise SetupError(f"{path}: is no report of a soak with an object; make it again") from None
    return dict(report)


def _silent(report: Report) -> str:
    """Without a fault that misleads, and after one."""
    after = report["silent_after"]
    misled = sum(after.get(kind, 0) for kind in laps.MISLEADING)
    return f"{sum(after.values()) - misled}, {misled}"


def _recovery(report: Report) -> str:
    worst = report["worst_recovery_s"]
    kind = max(worst, key=worst.__getitem__, default="")
    return f"{worst[kind]:.2f} s ({kind})" if kind else "none to see"


def _memory(report: Report) -> str:
    values = [mb for _, mb in report["rss_mb"]]
    if not values:
        return "too short to see"
    return f"{min(values):.0f}..{max(values):.0f} MB, {report['growth_mb']:+.1f} MB"


def _of_full(report: Report, key: str) -> str:
    full, some = report["full"], report[key]
    return f"{some} of {full} ({some / full:.1%})" if full else "none"


ROWS: dict[str, Callable[[Report], str]] = {
    "object, skin, clock": lambda r: f"{Path(r['object']).name}, `{r['physics']}`, {r['clock']}",
    "hours of scans": lambda r: f"{r['hours_done']:.1f}",
    "laps": lambda r: f"{r['laps']}",
    "scans sent": lambda r: f"{r['scans_sent']:,}".replace(",", " "),
    "frames delivered": lambda r: f"{r['units']:,}".replace(",", " "),
    "faults": lambda r: f"{sum(r['faults'].values())}",
    "frames, packets, scans and poses not accounted for": lambda r: f"{r['unexplained']}",
    "silent failures without a misleading fault in the lap, and after one": _silent,
    "object found at the lap's end": lambda r: f"{r['found']}",
    f"of laps in which all {laps.CONTACTS} contacts were felt": lambda r: _of_full(r, "full_found"),
    "of these, a valid estimate within 10 mm at the end": lambda r: _of_full(r, "full_right"),
    "worst recovery": _recovery,
    "not recovered in time": lambda r: f"{sum(r['not_recovered'].values())}",
    "still in doubt 3 s after": lambda r: f"{sum(r['doubted'].values())}",
    "flags late or never": lambda r: f"{sum(r['flags_missed'].values())}",
    "memory, and its growth from the first third to the last": _memory,
    "minutes of one core": lambda r: f"{r['cpu_s'] / 60:.0f}" if r["cpu_s"] else "not measured",
    "passed": lambda r: "yes" if r["passed"] else "no",
}
