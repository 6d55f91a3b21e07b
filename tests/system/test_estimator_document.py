"""A constant that docs/estimator.md names has the value that the page says."""

import re
from importlib import import_module
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "estimator.md"
ROWS = [
    [cell.strip() for cell in line.split("|")[1:-1]]
    for line in PAGE.read_text(encoding="utf-8").splitlines()
    if re.match(r"\| `\w+(\.\w+)*\.[A-Z]", line)
]
UNITS = {"mm": 1e-3}


def named(cell: str) -> list[tuple[str, str]]:
    """(module, constant) of a table's first column: `a.B`, `C` are both of a."""
    module, found = "", []
    for name in re.findall(r"`([\w.]+)`", cell):
        *before, constant = name.split(".")
        module = ".".join(before) or module
        found.append((module, constant))
    return found


def test_the_page_has_constants() -> None:
    assert len(ROWS) > 5


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_documented_constant_has_its_value(row: list[str]) -> None:
    held: list[float] = []
    for module, constant in named(row[0]):
        room = "" if "." in module else "estimator."
        value = getattr(import_module(f"taxeld.{room}{module}"), constant)
        held += value.tolist() if hasattr(value, "tolist") else [value]
    parts = [part.partition(" ") for part in row[1].split(", ")]
    said = [float(number) * UNITS.get(unit, 1.0) for number, _, unit in parts]
    assert held == pytest.approx(said)
