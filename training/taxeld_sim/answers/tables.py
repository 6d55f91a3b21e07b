"""Rows of answers as files and as tables, and the pages that show them.

    python -m taxeld_sim.answers.tables           fails where a page and its rows disagree, and
                                                      names rows that are older than the belief
    python -m taxeld_sim.answers.tables --write   writes the pages' tables anew

A block of a page stands between `<!-- figures: NAME | SPEC -->` and `<!-- end -->`;
`docs/results/NAME.json` has its rows, and `text` says what SPEC is.
"""

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

Row: TypeAlias = dict[str, Any]

ALL = "all"
SHARES = "found", "found_and_sure", "right", "near", "covered"  # counts of trials after each touch
HEADS = {
    "found_and_sure": "found and sure",
    "mm": "mm after",
    "near": "within 20 mm",
    "covered": "within its radius",
    "path_mm": "mm (10–90 %)",
    "misleading_at": "misleading after",
    "ms": "ms a touch",
    "ece": "error of p",
    "to_sure": "touches to sure",
}
BELIEF = "bundles", "estimator", "model", "pipeline", "proposals", "skin"  # rooms of the daemon
DOCS = Path(__file__).parents[3] / "docs"
BLOCK = re.compile(r"(<!-- figures: (\w+) \| ([^\n]*) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def text(rows: Sequence[Row], spec: str) -> str:
    """A table in Markdown, by `LABEL=VALUE, … | LABEL | FIGURE TOUCH … [by LABEL] | … | all`.

    First stands what all its rows have in common, if anything, then what a line is of, then the
    columns: a figure after some touches, or of all. `by` a label makes a column of each of the
    label's values. `all` ends the table with a line without the label of the lines.
    """
    parts = [part.strip() for part in spec.split("|")]
    fixed = dict(each.split("=") for each in parts.pop(0).split(", ")) if "=" in parts[0] else {}
    line, *words = parts
    of = {_key(row["of"]): row for row in rows}
    columns = [column for each in words if each != ALL for column in _columns(each, rows)]
    lines = {value: fixed | {line: value} for value in _values(rows, line)}
    if ALL in words:
        lines[ALL] = fixed
    made = [
        [word(name), *(column.cell(of.get(_key(labels | column.labels))) for column in columns)]
        for name, labels in lines.items()
    ]
    table = [[line, *(each.head for each in columns)], *(each for each in made if any(each[1:]))]
    head, *filled = (f"| {' | '.join(each)} |" for each in table)
    return "\n".join([head, "|---" * len(table[0]) + "|", *filled])


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    figure: str
    touches: tuple[int, ...]  # after which; none: of all
    labels: dict[str, str]  # beside those of the line

    @property
    def head(self) -> str:
        own = self.figure.removesuffix("±")
        said = " ".join([HEADS.get(own, own), *map(str, self.touches)])
        return ", ".join([*self.labels.values(), said])

    def cell(self, row: Row | None) -> str:
        if row is None:
            return ""
        if self.touches:
            each = [self._after(row, n) for n in self.touches]
            return " / ".join([*(said.removesuffix(" %") for said in each[:-1]), each[-1]])
        own = self.figure.removesuffix("±")
        if own == "misleading":
            return f"{row[own]} of {row['sure']}{self._interval(row, own)}"
        value = row.get(own)
        if value is None:
            return ""
        if own == "path_mm":
            return f"{value[1]:.1f} ({value[0]:.1f}–{value[2]:.1f})"
        said = f"{value:.3g}" if isinstance(value, float) else str(value)
        return said + self._interval(row, own)

    def _after(self, row: Row, n: int) -> str:
        own = self.figure.removesuffix("±")
        if own == "mm":
            middle, most = (row[name][n - 1] for name in ("median_mm", "q90_mm"))
            return "" if middle is None else f"{middle:.1f} ({most:.0f})"
        value = row[own][n - 1] if own in row else None
        if value is None:
            return ""
        if own in SHARES:
            return share(value, row["trials"]) + self._interval(row, own, n)
        return f"{value:.3g}"

    def _interval(self, row: Row, own: str, n: int = 0) -> str:
        ends = row.get("ci", {}).get(own) if self.figure.endswith("±") else None
        if ends is None:
            return ""
        low, high = ends[n - 1] if n else ends
        if own in (*SHARES, "misleading"):
            low, high = 100 * low, 100 * high
            return f" ({low:.{0 if low >= 1.0 else 1}f}–{high:.{0 if high >= 1.0 else 1}f} %)"
        return f" ({low:.3g}–{high:.3g})"


def _columns(words: str, rows: Sequence[Row]) -> list[Column]:
    """The columns of a part of a spec."""
    words, _, pivot = words.partition(" by ")
    name, *numbers = words.split()
    touches = tuple(map(int, numbers))
    if pivot:
        return [Column(name, touches, {pivot: value}) for value in _values(rows, pivot)]
    return [Column(name, (n,), {}) for n in touches] or [Column(name, (), {})]


def _values(rows: Sequence[Row], label: str) -> list[str]:
    return list(dict.fromkeys(row["of"][label] for row in rows if label in row["of"]))


def _key(labels: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted(labels.items()))


def share(count: int, of: int) -> str:
    """35 of 40 → 88 %, which is never rounded to all or none."""
    rounded = round(100 * count / of)
    if 0 < count < of:
        rounded = min(max(rounded, 1), 99)
    return f"{rounded} %"


def word(name: str) -> str:
    """003_cracker_box → cracker box."""
    return re.sub(r"^\d+(-\w)?_", "", name).replace("_", " ")


def filled(page: str) -> str:
    """A page with its blocks as the rows have them."""

    def made(block: re.Match[str]) -> str:
        head, name, spec, _, end = block.groups()
        kept = (DOCS / "results" / f"{name}.json").read_text(encoding="utf-8")
        return f"{head}{text(json.loads(kept)['rows'], spec)}\n{end}"

    return BLOCK.sub(made, page)


def main(arguments: list[str]) -> int:
    """0: all pages are as their rows have it, or are now."""
    stale = 0
    for page in sorted(DOCS.rglob("*.md")):
        given = page.read_text(encoding="utf-8")
        if (now := filled(given)) == given:
            continue
        if arguments == ["--write"]:
            page.write_text(now, encoding="utf-8")
        else:
            stale += 1
            name = page.relative_to(DOCS.parent)
            sys.stderr.write(f"{name}: not what its rows say; --write fills it\n")
    sys.stderr.writelines(f"{line}\n" for line in older())
    return int(stale > 0)


def older() -> Iterator[str]:
    """A line for each file of rows whose commit is older than the last one that changes what the
    daemon believes, as far as this tree's history goes."""
    rooms = [f":(top)daemon/taxeld/{room}" for room in BELIEF]
    for path in sorted((DOCS / "results").glob("*.json")):
        made = json.loads(path.read_text(encoding="utf-8"))["commit"].removesuffix("-dirty")
        later = git(DOCS, "rev-list", "--count", f"{made}..HEAD", "--", *rooms)
        if later.strip("0"):
            yield f"{path.name}: of {made}; commits since then that change the belief: {later}"


def git(place: Path, *words: str) -> str:
    """What git says in a folder; empty where it fails."""
    asked = ["git", "-C", str(place), *words]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()  # noqa: S603


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
