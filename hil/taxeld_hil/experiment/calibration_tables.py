"""The runs of `taxeld-hil calibration` in few numbers, and these as tables."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from taxeld_hil.experiment.calibration_runs import AFTER


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A row for each sort, object and skin."""
    found = []
    for sort, name, skin in dict.fromkeys((r["sort"], r["object"], r["skin"]) for r in rows):
        mine = [r for r in rows if (r["sort"], r["object"], r["skin"]) == (sort, name, skin)]
        head = {"sort": sort, "object": name, "skin": skin, "seeds": len(mine)}
        if sort == "find":
            for kind in ("given", "found"):
                good = [r[kind] for r in mine if "refused" not in r[kind]]
                head[kind] = {"refused": len(mine) - len(good)} | {
                    key: {
                        "median": _quantile([g[key] for g in good], 0.5),
                        "most": _quantile([g[key] for g in good], 1.0),
                    }
                    for key in ("gains_known", "gain_off", "mount_off_mm", "yaw_off_deg")
                    if good
                }
        elif sort == "buy":
            for kind in ("without", "without, mount off", "with"):
                head[kind] = {
                    f"after_{n}": _quantile([r[kind][k] for r in mine], 0.5)
                    for k, n in enumerate(AFTER)
                }
        else:
            after = [r["noticed_after"] for r in mine]
            head["raised"] = int(np.count_nonzero(after))
            head["within_8"] = sum(0 < n <= 8 for n in after)
            head["suspects"] = {
                s: sum(r["suspect"] == s for r in mine)
                for s in sorted({r["suspect"] for r in mine})
            }
        found.append(head)
    return found


def lines(path: Path) -> Iterator[str]:
    """The summary of such a file, as Markdown tables."""
    rows = json.loads(path.read_text(encoding="utf-8"))["summary"]
    yield "| skin, pose | runs, refused | gains known | off: gains, median (most) | mount | yaw |"
    yield "|---|---|---|---|---|---|"
    for row in (r for r in rows if r["sort"] == "find"):
        for kind in ("given", "found"):
            one = row[kind]
            if "gain_off" not in one:
                yield f"| {row['skin']}, {kind} | {row['seeds']}, {one['refused']} | | | | |"
                continue
            gain, mount, yaw = one["gain_off"], one["mount_off_mm"], one["yaw_off_deg"]
            yield (
                f"| {row['skin']}, {kind} | {row['seeds']}, {one['refused']} "
                f"| {one['gains_known']['median']:.0f} "
                f"| {gain['median']:.1%} ({gain['most']:.1%}) "
                f"| {mount['median']:.2f} ({mount['most']:.2f}) mm "
                f"| {yaw['median']:.2f} ({yaw['most']:.2f})° |"
            )
    yield ""
    yield (
        "| skin | median error after "
        + ", ".join(map(str, AFTER))
        + " touches | without | with the mount off | with |"
    )
    yield "|---|---|---|---|---|"
    for row in (r for r in rows if r["sort"] == "buy"):
        cells = [
            ", ".join(f"{mm:.2f}" for mm in row[kind].values()) + " mm"
            for kind in ("without", "without, mount off", "with")
        ]
        yield f"| {row['skin']}, {row['seeds']} seeds | " + " | ".join(cells) + " |"
    yield ""
    yield "| what is wrong | skin, object | runs | doubts | within 8 touches | about |"
    yield "|---|---|---|---|---|---|"
    for row in (r for r in rows if "raised" in r):
        about = ", ".join(f"{n} {s}" for s, n in row["suspects"].items() if s)
        yield (
            f"| {row['sort']} | {row['skin']}, {row['object']} | {row['seeds']} | {row['raised']} "
            f"| {row['within_8']} | {about} |"
        )


def rounded(value: Any) -> float:
    """To four digits after the point."""
    return round(float(value), 4)


def _quantile(values: list[Any], share: float) -> float | None:
    numbers = [v for v in values if v is not None]
    return rounded(np.quantile(numbers, share)) if numbers else None
