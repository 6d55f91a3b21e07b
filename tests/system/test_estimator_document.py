"""docs/estimator.md names every constant of the estimator, with the value that it has."""

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

import taxeld.estimator

ROOT = Path(__file__).parents[2]
ROOM = Path(taxeld.estimator.__file__).parent
ROWS = [
    [cell.strip() for cell in line.split("|")[1:-1]]
    for line in (ROOT / "docs" / "estimator.md").read_text(encoding="utf-8").splitlines()
    if re.match(r"\| `\w+(\.\w+)*\.[A-Z]", line)
]
UNITS = {"mm": 1e-3, "mrad": 1e-3}


def named(cell: str) -> list[tuple[str, str]]:
    """(module, constant) of a table's first column: `a.B`, `C` are both of a."""
    module, found = "", []
    for name in re.findall(r"`([\w.]+)`", cell):
        *before, constant = name.split(".")
        module = ".".join(before) or module
        found.append((module, constant))
    return found


def test_every_constant_is_documented() -> None:
    documented = {pair for row in ROWS for pair in named(row[0])}
    for path in sorted(ROOM.glob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Assign):
                names = [n.id for t in node.targets for n in ast.walk(t) if isinstance(n, ast.Name)]
                for name in filter(str.isupper, names):
                    if name not in ("RULES", "T"):  # no quantities
                        assert (path.stem, name) in documented, f"{path.name}: {name}"


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_documented_constant_has_its_value(row: list[str]) -> None:
    pairs = named(row[0])
    values = [
        getattr(import_module(f"taxeld.{'' if '.' in module else 'estimator.'}{module}"), constant)
        for module, constant in pairs
    ]
    if len(pairs) == 1 and re.fullmatch(r"[\d.]+( \w+)?", row[1]):
        number, _, unit = row[1].partition(" ")
        assert values[0] == pytest.approx(float(number) * UNITS.get(unit, 1.0))
    elif all(re.fullmatch(r"[\d.]+( \w+)?", part) for part in row[1].split(", ")):
        flat = [x for v in values for x in (v.tolist() if hasattr(v, "tolist") else [v])]
        for value, part in zip(flat, row[1].split(", "), strict=True):
            number, _, unit = part.partition(" ")
            assert value == pytest.approx(float(number) * UNITS.get(unit, 1.0))
