"""How long the code may be: `make lint` holds each room, and the tests' share, to its row in
pyproject.toml.

`tests/lines.py --now` prints a table of today's lengths and 3 % more, for [tool.taxeld.lines].
"""

import sys
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCES = ("firmware_protocol", "daemon", "training", "hil", "ros2")
OTHERS = ("benchmarks", "deploy", "examples")
SPARE = 1.03
SHARE = "tests for a line outside"


def lengths() -> Counter[str]:
    """Lines of Python by room, a folder of a package or its top, and in all; words of the pages."""
    found: Counter[str] = Counter()
    for source in SOURCES:
        for path in (ROOT / source).glob("*/**/*.py"):
            package, *rooms = path.relative_to(ROOT / source).parts[:-1]
            found[".".join([package, *rooms[:1]])] += _lines(path)
    for name in (*OTHERS, "tests"):
        found[name] = sum(map(_lines, (ROOT / name).rglob("*.py")))
    found["outside tests"] = found.total() - found["tests"]
    found["words of pages"] = sum(len(_text(path).split()) for path in (ROOT / "docs").glob("*.md"))
    return found


def _lines(path: Path) -> int:
    return len(_text(path).splitlines())


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


if __name__ == "__main__":
    now = lengths()
    table = tomllib.loads(_text(ROOT / "pyproject.toml"))["tool"]["taxeld"]["lines"]
    if "--now" in sys.argv:
        print("\n".join(f'"{room}" = {round(now[room] * SPARE)}' for room in sorted(now)))
    else:
        found = {**now, SHARE: round(now["tests"] / now["outside tests"], 3)}
        over = [room for room in sorted(found) if found[room] > table.get(room, 0)]
        for room in over:
            print(f"{room}: {found[room]}, not {table.get(room, 0)}")
        sys.exit(bool(over))
