"""Layout files and iCub's positions: every trap of the formats on a small file; real files."""

import dataclasses
import json
import math
import os
import re
import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.commands.layout import arc_rad, pitch_m, tilted
from taxeld.config.tables import SourceConfig
from taxeld.layout import read as layouts
from taxeld.source.sources import live
from taxeld_protocol.array import ArrayDecoder
from taxeld_protocol.modules import NAMES
from tests.rig.commands import refuses
from tests.rig.skins import table_of

RADIUS_M = 0.05
ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data" / "layouts"
RING = layouts.load("cylinder:rows=3,columns=16,radius_m=0.05,pitch_m=0.01")
Change = Callable[[dict[str, Any], list[dict[str, Any]]], object]


def taxel(i: int) -> dict[str, Any]:
    """Taxel i of 8 columns over half a circle about the file's y axis, module 3 + i // 10."""
    n = [math.cos(math.pi * (i % 8) / 7), 0.0, math.sin(math.pi * (i % 8) / 7)]
    x = [RADIUS_M * n[0], 0.1 + 0.008 * (i // 8), RADIUS_M * n[2]]
    return {"id": (3 + i // 10) << 4 | (i % 10 + 1), "x": x, "n": n, "type": "pressure", "cut": 0}


def document(taxels: int = 40, change: Change = lambda *_: None) -> dict[str, Any]:
    """A file, after a change of its `skin` and of the list of its taxels."""
    entries = [taxel(i) for i in range(taxels)]
    skin = {"parent_frames": [{"key": 0}], "taxels": entries, "faces": []}
    change(skin, entries)
    return {"info": {"file_version": "2", "type": "rigid_body", "name": "link"}, "skin": skin}


def of_taxel(i: int, **values: Any) -> dict[str, Any]:
    """A file in which taxel i has other values."""
    return document(change=lambda _, taxels: taxels[i].update(values))


def written(place: Path, content: Any, name: str = "skin.json") -> str:
    """The file of a document, of text or of bytes."""
    content = content if isinstance(content, str | bytes) else json.dumps(content)
    (place / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return str(place / name)


def test_taxels_come_in_file_order_in_the_sensor_frame(tmp_path: Path) -> None:
    skin = layouts.read(written(tmp_path, document()))
    assert (skin.name, skin.uid.tolist()) == ("skin", [taxel(i)["id"] for i in range(40)])
    assert (skin.radius_m, skin.rms_m) == pytest.approx((RADIUS_M, 0.0))
    angle, z = np.arctan2(*skin.position_m.T[1::-1]), skin.position_m[:, 2]
    np.testing.assert_allclose(z, np.repeat(range(-2, 3), 8) * 0.008, atol=1e-12)
    outwards = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    np.testing.assert_allclose(skin.normal, outwards, atol=1e-12)
    there = np.array([[*taxel(i)["x"], 1.0] for i in range(40)]) @ skin.frame.T
    np.testing.assert_allclose(there[:, :3], skin.position_m, atol=1e-12)
    turn = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(skin.frame[:3, :3], turn, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "counts"),
    [
        ({4: {"id": -1, "x": None}, 9: {"id": -1}}, (2, 0, 0)),
        ({4: {"id": 3 << 4}, 5: {"type": "temperature"}}, (2, 0, 0)),
        ({4: {"cut": 1}, 5: {"cut": 7}}, (0, 2, 0)),
        ({9: {"id": taxel(4)["id"]}}, (0, 0, 1)),  # the first counts
        ({4: {"id": taxel(9)["id"], "cut": 1}}, (0, 1, 0)),
    ],
    ids=["missing", "temperature", "cut", "duplicate", "cut one of a live one's id"],
)
def test_an_entry_that_is_no_taxel_is_left_out_and_counted(
    tmp_path: Path, changes: dict[int, dict[str, Any]], counts: tuple[int, int, int]
) -> None:
    file = document(change=lambda _, taxels: [taxels[i].update(v) for i, v in changes.items()])
    skin = layouts.read(written(tmp_path, file))
    assert (skin.source.missing, skin.source.cut, skin.source.duplicates) == counts
    left = [taxel(i) for i in range(40) if i not in changes]
    assert skin.uid.tolist() == [each["id"] for each in left]
    there = np.array([[*each["x"], 1.0] for each in left]) @ skin.frame.T
    np.testing.assert_allclose(skin.position_m, there[:, :3], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "unit", "turned"),
    [
        (lambda skin, taxels: skin.update(taxels=[taxels[:15], taxels[15:]]), "m", 0),
        (lambda _, taxels: [t.update(n=[-v for v in t["n"]]) for t in taxels], "m", 40),
        (lambda _, taxels: [t.update(n=[0.3 * v for v in t["n"]]) for t in taxels], "m", 0),
        (lambda _, taxels: [t.update(x=[1e3 * v for v in t["x"]]) for t in taxels], "mm", 0),
    ],
    ids=["grouped in lists", "inward normals", "short normals", "millimetres"],
)
def test_what_files_write_in_several_ways_gives_the_same_skin(
    tmp_path: Path, change: Change, unit: str, turned: int
) -> None:
    whole = document(change=change) | {"tactile_maps": [{"taxels": [{"id": 1}]}]}
    skin = layouts.read(written(tmp_path, whole))
    assert skin.digest == layouts.read(written(tmp_path, document())).digest
    assert (skin.source.unit, skin.turned) == (unit, turned)


AT, OWN = "skin.taxels[12]", table_of(RING, uid=True)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (of_taxel(12, id=None), f"{AT}.id: must be an integer, not None; correct it, or mark"),
        (of_taxel(12, id=-2), f"{AT}.id: must be -1..6.87195e+10, not -2"),
        (of_taxel(12, id=1 << 36), f"{AT}.id: must be "),
        (of_taxel(12, id=3 << 4 | NAMES), f"{AT}.id: 60 is taxel 12 of its module, which has"),
        (of_taxel(12, x=[0.1, 0.2]), f"{AT}.x: must be a list of 3, not [0.1, 0.2]; correct it"),
        (of_taxel(12, x=None), f"{AT}: needs x and n; correct it"),
        (of_taxel(12, x=[0.0, 9e15, 0.0]), "taxels span 9e+15, too far"),
        (of_taxel(12, n=[1e-300, 0, 0]), "taxel 67: the normal must not be zero; correct it"),
        (
            document(change=lambda skin, taxels: skin.update(taxels=[taxels, [{"id": "x"}]])),
            "skin.taxels[1][0].id: must be an integer",
        ),
        (
            document(change=lambda skin, _: skin.update(taxels=[1])),
            "skin.taxels[0]: must be a table",
        ),
        (document(0), "holds 0 usable taxels"),
        (document(change=lambda skin, _: skin.update(taxels={})), "skin.taxels: must be a list"),
        ([], "info, skin: must be objects; name a robotskinlib file"),
        ({"info": {"file_version": 2}}, "info, skin: must be objects"),
        ({"info": {"file_version": 1}, "skin": {}}, "info.file_version: must be 2, not 1"),
        (b"", "is not JSON"),
        (b"\x80PNG", "is not UTF-8 text"),
        *(
            (OWN.replace(old, new, 1), words)
            for old, new, words in (
                ("nx", "a", "line 1: must be uid,x,y,z,nx,ny,nz; uid or the n… may lack"),
                (OWN, "", "line 1: must be uid"),
                (OWN.partition("\n")[2], "", "holds 0 usable taxels"),
                ("0.050000", "wide", "line 2: must be 7 numbers, not 'wide,"),
                ("0.050000", "nan", "line 2: must be 7 numbers, not 'nan,"),
                (",17\n", "\n", "line 2: must be 7 numbers, not "),
                (",17\n", ",18\n", "line 3: 18 is no UID, or one for the second time"),
                (",17\n", ",-1\n", "line 2: -1 is no UID"),
                (",17\n", ",17.5\n", "line 2: 17.5 is no UID"),
                (
                    "1.000000,0.000000,0.000000,17",
                    "0,0,0,17",
                    "taxel 17: the normal must not be ze",
                ),
            )
        ),
    ],
)
def test_a_fault_names_its_place_and_the_cure(tmp_path: Path, content: Any, words: str) -> None:
    path = written(tmp_path, content, "own.csv" if isinstance(content, str) else "skin.json")
    refuses("^" + re.escape(f"skin.layout: {path}: {words}"), layouts.read, path)


def test_a_flat_patch_can_be_read_but_not_run(tmp_path: Path) -> None:
    flat = {"n": [0, 0, -1]}
    file = document(
        change=lambda _, taxels: [t.update(flat, x=[*t["x"][:2], 0.02]) for t in taxels]
    )
    skin = layouts.read(written(tmp_path, file))
    assert (skin.radius_m, math.isnan(skin.rms_m)) == (math.inf, True)
    np.testing.assert_allclose(skin.normal, [[0, 0, 1]] * 40)
    np.testing.assert_allclose(skin.position_m[:, 2], 0.0, atol=1e-12)
    refuses(
        r"skin\.layout: skin: its 40 taxels lie on no cylinder",
        layouts.load,
        str(tmp_path / "skin.json"),
    )


@pytest.mark.parametrize("uid", [False, True])
def test_a_table_has_the_taxels_of_the_layout_that_was_written(tmp_path: Path, uid: bool) -> None:
    own = dataclasses.replace(RING, uid=RING.uid + 160 * uid)
    found = layouts.read(written(tmp_path, table_of(own, uid=uid), "own.csv"))
    assert (found.name, found.radius_m) == ("own", pytest.approx(0.05, abs=1e-5))
    assert found.uid.tolist() == own.uid.tolist()
    turn, shift = found.frame[:3, :3], found.frame[:3, 3]
    np.testing.assert_allclose(found.position_m, own.position_m @ turn.T + shift, atol=2e-6)


def test_a_table_without_normals_has_those_of_its_cylinder(tmp_path: Path) -> None:
    lines = [f"{100 - i},{x},{y},{z}" for i, (x, y, z) in enumerate(RING.position_m.tolist())]
    found = layouts.read(written(tmp_path, "\n".join(["uid,x,y,z", *lines, ""]), "own.csv"))
    assert found.uid.tolist() == [100 - i for i in range(len(RING))]
    assert found.radius_m == pytest.approx(0.05, abs=1e-4)
    radial = found.position_m * (1.0, 1.0, 0.0) / 0.05
    assert np.einsum("ij,ij->i", found.normal, radial).min() > 0.999, "outwards"


def test_uids_that_no_module_has_are_of_arrays_alone() -> None:
    own = dataclasses.replace(RING, uid=np.arange(len(RING)))
    ArrayDecoder(own.uid.tolist())
    refuses(
        r"skin\.layout: its UIDs are of no module.*of an array", live, SourceConfig(kind="can"), own
    )


@pytest.mark.skipif(not REAL.is_dir(), reason="the real layouts are not beside this checkout")
@pytest.mark.parametrize(
    ("name", "taxels", "modules", "radius_mm", "arc_deg", "height_mm"),
    [
        ("ur10e_link1_patch1", 642, 60, 72.0, 181.0, 130.0),
        ("ur10e_link2_patch1", 524, 51, 63.0, 178.0, 147.0),
        ("hexagon_cyskin_full_isomap", 61, 6, math.inf, 0.0, 0.0),
        ("hexagon_tpu_1_full_isomap", 59, 6, math.inf, 0.0, 0.0),
    ],
)
def test_real_skins_are_half_cylinders_and_flat_hexagons(
    name: str, taxels: int, modules: int, radius_mm: float, arc_deg: float, height_mm: float
) -> None:
    skin = layouts.read(str(REAL / f"{name}.json"))
    found = len(skin), len(np.unique(skin.uid >> 4)), skin.source.unit, skin.turned
    assert found == (taxels, modules, "m", 0)
    radius, height, arc = skin.radius_m * 1e3, np.ptp(skin.position_m[:, 2]) * 1e3, arc_rad(skin)
    assert (radius, height) == pytest.approx((radius_mm, height_mm), abs=2.0)
    assert 6.0 < pitch_m(skin) * 1e3 < 8.0
    if math.isfinite(radius_mm):
        assert (skin.rms_m < 2.5e-3, len(skin.turns), tilted(skin)) == (True, 1, 0)
        assert math.degrees(arc) == pytest.approx(arc_deg, abs=1.0)
        assert skin.frame[2, 1] > 0.999_999, "along the file's y"


TABLE = runpy.run_path(str(ROOT / "examples" / "icub_positions.py"))["table"]
OFFICIAL = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data" / "icub_positions"
SLOTS = range(48)
ZEROS = "0 0 0 -0.000 0 0"
OWN = [12 * (i // 12) + 3 for i in SLOTS]  # each slot's triangle is one of the common kind


ROWS = [  # four triangles in rows of twelve around half a circle
    f"{0.006 * (i // 12)}\t{RADIUS_M * math.cos(a)} {RADIUS_M * math.sin(a)} "
    f"0 {math.cos(a)} {math.sin(a)}"
    for i, a in ((i, math.pi * (i % 12) / 11) for i in SLOTS)
]


def slots_of(lines: list[str], middles: list[int] | None) -> list[int]:
    """The slots that are taxels of a file, counted through its triangles."""
    header = f"taxel2Repr (  {' '.join(map(str, middles))}  )\n" if middles else ""
    table = TABLE(f"name r_forearm\n{header}[calibration]\n" + "\n".join(lines) + "\n\n")
    uids = (int(line.split(",")[0]) for line in table.splitlines()[1:])
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
    assert slots_of(ROWS, middles) == [*left]
    assert slots_of([*ROWS[:13], ZEROS, *ROWS[14:]], middles) == [i for i in left if i != 13]


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
    table = TABLE((OFFICIAL / f"{name}.txt").read_text(encoding="ascii"))
    skin = layouts.read(written(tmp_path, table, "skin.csv"))
    found = len(skin), len(np.unique(skin.uid >> 4)), skin.radius_m * 1e3
    assert found == (taxels, triangles, pytest.approx(radius_mm, abs=0.05))
