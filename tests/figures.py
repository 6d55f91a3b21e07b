"""Figures of the pages come from docs/results: a block of a page holds what its JSON says.

    python tests/figures.py           fails where a page and its JSON disagree
    python tests/figures.py --write   writes the blocks anew

A block stands between `<!-- figures: NAME -->` and `<!-- end of figures -->`.
"""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"(<!-- figures: (\S+) -->\n)(.*?)(<!-- end of figures -->)", re.DOTALL)
AFTER = (3, 6, 8)  # touches that pages show

Rows = list[dict[str, Any]]
Line = list[str]


def rows_of(name: str) -> Rows:
    return list(json.loads((DOCS / "results" / f"{name}.json").read_text(encoding="utf-8")))


def table(heads: Line, lines: list[Line]) -> str:
    """A table in Markdown."""
    return "\n".join(f"| {' | '.join(line)} |" for line in [heads, ["---"] * len(heads), *lines])


def word(name: str) -> str:
    """003_cracker_box → cracker box."""
    return re.sub(r"^\d+(-\w)?_", "", name).replace("_", " ")


def share(count: int, of: int) -> str:
    """35 of 40 → 88 %, which is never rounded to all or none."""
    rounded = round(100 * count / of)
    if 0 < count < of:
        rounded = min(max(rounded, 1), 99)
    return f"{rounded} %"


def works(skin: str) -> Callable[[], str]:
    """An object a line, on one skin, after few and many touches."""

    def made() -> str:
        lines = [
            [
                word(row["object"]),
                *(f"{row['median_mm'][n - 1]:.1f} ({row['q90_mm'][n - 1]:.0f})" for n in AFTER),
                *(share(row["found"][n - 1], row["trials"]) for n in AFTER),
                *(share(row["found_and_sure"][n - 1], row["trials"]) for n in AFTER),
                f"{row['misleading']} of {row['sure']}",
            ]
            for row in rows_of("works")
            if row["skin"] == skin
        ]
        heads = ["object", *(f"mm after {n}" for n in AFTER), *(f"found, {n}" for n in AFTER)]
        return table([*heads, *(f"found and sure, {n}" for n in AFTER), "misleading"], lines)

    return made


def most_misleading() -> str:
    """All of `works` in one line."""
    rows = rows_of("works")
    wrong, sure = (sum(row[key] for row in rows) for key in ("misleading", "sure"))
    return f"Over all rows {wrong} of {sure} sure estimates mislead."


def advice() -> str:
    """Right and sure by who chose the touches, an object and cell a line."""
    rows = rows_of("advice")
    of = {(row["object"], row["cell"], row["guide"]): row for row in rows}
    guides = ("any", "random", "advice")
    lines = []
    for name, cell in dict.fromkeys((row["object"], row["cell"]) for row in rows):
        own = [of.get((name, cell, guide)) for guide in guides]
        shares = [
            " ".join(f"{100 * row['found_and_sure'][n - 1] / row['trials']:.0f}" for n in (4, 6, 8))
            if row
            else ""
            for row in own
        ]
        trials = "/".join(str(row["trials"]) for row in own if row)
        misleading = "/".join(str(row["misleading"]) for row in own if row)
        lines.append([word(name), cell, *shares, trials, misleading])
    heads = ["object", "cell", *(f"{guide}, %" for guide in guides), "trials", "misleading"]
    return table(heads, lines)


def reliability() -> str:
    """How far p and radius hold: all conditions, and parts of them."""
    rows = {row["over"]: row for row in rows_of("reliability") if "over" in row}
    parts = ("all", "tuned", "not tuned", "soft skin", "wrong object")
    lines = [
        [
            part,
            str(row["estimates"]),
            f"{row['ece']:.3f}",
            f"{row['misleading']} of {row['sure']}",
            " ".join(f"{100 * share:.0f}" for share in found if share is not None),
        ]
        for part in parts
        for row in [rows[part]]
        for found in [[row[f"found_and_sure_{n}"] for n in (4, 6, 8)]]
    ]
    heads = ["part", "estimates", "calibration error of p", "misleading, of the sure"]
    return table([*heads, "found and sure after 4, 6, 8, %"], lines)


FIGURES: dict[str, Callable[[], str]] = {
    "works-typical": works("typical"),
    "works-poor": works("poor"),
    "works-robot": works("robot errs by 2 mm"),
    "advice": advice,
    "works-misleading": most_misleading,
    "reliability": reliability,
}


def filled(page: str) -> str:
    """A page with its blocks as the JSON has them.

    Raises:
        KeyError: no figures are called so.
    """
    return BLOCK.sub(lambda at: f"{at[1]}{FIGURES[at[2]]()}\n{at[4]}", page)


def main(arguments: list[str]) -> int:
    stale = 0
    for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]:
        text = page.read_text(encoding="utf-8")
        now = filled(text)
        if now == text:
            continue
        if arguments == ["--write"]:
            page.write_text(now, encoding="utf-8")
        else:
            stale += 1
            print(f"{page.relative_to(ROOT)}: not what its JSON says: tests/figures.py --write")
    return stale > 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
