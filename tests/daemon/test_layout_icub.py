"""examples/icub_positions.py: the traps of iCub's positions files, in small and official ones."""

import math
import os
import runpy
from pathlib import Path

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout

ROOT = Path(__file__).parents[2]
TABLE = runpy.run_path(str(ROOT / "examples" / "icub_positions.py"))["table"]
OFFICIAL = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data" / "icub_positions"
RADIUS_M = 0.05
SLOTS = range(48)
ZEROS = "0 0 0 -0.000 0 0"
OWN = [12 * (i // 12) + 3 for i in SLOTS]  # each slot's triangle is one of the common kind


def rows() -> list[str]:
    """Four triangles in rows of twelve around half a circle."""
    angles = [math.pi * (i % 12) / 11 for i in SLOTS]
    return [
        f"{0.006 * (i // 12)}\t{RADIUS_M * math.cos(a)} {RADIUS_M * math.sin(a)} "
        f"0 {math.cos(a)} {math.sin(a)}"
        for i, a in enumerate(angles)
    ]


def converted(place: Path, text: str) -> Layout:
    table = place / "skin.csv"
    table.write_text(TABLE(text), encoding="ascii")
    return layouts.read(str(table))


def slots_of(lines: list[str], middles: list[int] | None = None) -> list[int]:
    """The slots that are taxels of a file, counted through its triangles."""
    header = f"taxel2Repr (  {' '.join(map(str, middles))}  )\n" if middles else ""
    table = TABLE(f"name r_forearm\n{header}[calibration]\n" + "\n".join(lines) + "\n\n")
    uids = [int(line.split(",")[0]) for line in table.splitlines()[1:]]
    return [12 * (uid >> 4) + (uid & 0xF) for uid in uids]


@pytest.mark.parametrize(
    ("middles", "left"),
    [
        (None, SLOTS),
        ([9 if i < 24 else -2 for i in SLOTS], range(24)),  # without a representative
        *(([5] * entries, SLOTS) for entries in (36, 47, 49, 960)),  # official files list 960
        # a common triangle's slots 6 and 10 are thermal pads, a palm's and a fingertip's are taxels
        (OWN, [i for i in SLOTS if i % 12 not in (6, 10)]),
        ([i + 6 for i in OWN], SLOTS),
        ([99 if i % 12 < 6 else 101 for i in SLOTS], SLOTS),
    ],
)
def test_a_row_is_a_taxel_as_taxel2repr_says(middles: list[int] | None, left: list[int]) -> None:
    assert slots_of(rows(), middles) == [*left]
    lines = rows()
    lines[13] = ZEROS
    assert slots_of(lines, middles) == [i for i in left if i != 13]


@pytest.mark.parametrize(
    "text", ["name r_forearm\n", "[calibration]\n0.1 0.2 0.3\n", f"[calibration]\n{ZEROS}\n"]
)
def test_what_is_no_positions_file_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"^[^\n]+$"):
        TABLE(text)


@pytest.mark.skipif(not OFFICIAL.is_dir(), reason="iCub's positions are not beside this checkout")
@pytest.mark.parametrize(
    ("name", "taxels", "triangles", "radius_mm"),
    [
        ("left_forearm_V2", 240, 24, 37.0),
        ("torso", 440, 44, math.inf),
    ],
)
def test_official_files_are_converted(
    tmp_path: Path, name: str, taxels: int, triangles: int, radius_mm: float
) -> None:
    skin = converted(tmp_path, (OFFICIAL / f"{name}.txt").read_text(encoding="ascii"))
    assert (len(skin), len(np.unique(skin.uid >> 4))) == (taxels, triangles)
    assert skin.radius_m * 1e3 == pytest.approx(radius_mm, abs=0.05)
