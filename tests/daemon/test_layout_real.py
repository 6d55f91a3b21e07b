"""The layouts of real skins, where they lie beside this checkout."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.layout import arc_rad, pitch_m, tilted
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.files import THERMAL

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data"
REAL = DATA / "layouts"
POSITIONS = DATA / "icub_positions"
DOCUMENTED = ROOT / "docs" / "results" / "icub_positions.md"


def documented() -> list[tuple[str, list[int], str, bool]]:
    """The official iCub files as the documents have them: name, taxels, triangles, boards and
    thermal pads, radius [mm] or what else, and whether its normals tell anything."""
    rows = []
    for line in DOCUMENTED.read_text(encoding="utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 7 and cells[1].isdigit():
            names = cells[0].split(", ")
            radii = cells[5].removesuffix(" mm").split(", ") * (2 if "mm" not in cells[5] else 1)
            counts = [int(cell) for cell in cells[1:5]]
            rows += [(n, counts, r, cells[6] == "own") for n, r in zip(names, radii, strict=False)]
    return rows


ICUB = documented()
KINDS = {"flat": r"they lie flat\)", "a dome": r"they lie as on a dome, bent 7\d% as much along"}


@pytest.mark.skipif(not REAL.is_dir(), reason="the real layouts are not beside this checkout")
class TestReal:
    @pytest.mark.parametrize(
        ("name", "taxels", "modules", "radius_mm", "arc_deg", "height_mm"),
        [
            ("ur10e_link1_patch1", 642, 60, 72.0, 181.0, 130.0),
            ("ur10e_link2_patch1", 524, 51, 63.0, 178.0, 147.0),
        ],
    )
    def test_arm_links_are_half_cylinders(
        self, name, taxels, modules, radius_mm, arc_deg, height_mm
    ):
        skin = layouts.load(str(REAL / f"{name}.json"))
        assert len(skin) == taxels
        assert len(np.unique(skin.uid >> 4)) == modules
        assert skin.radius_m * 1e3 == pytest.approx(radius_mm, abs=2.0)
        assert skin.rms_m * 1e3 < 2.5
        assert math.degrees(arc_rad(skin)) == pytest.approx(arc_deg, abs=1.0)
        assert np.ptp(skin.position_m[:, 2]) * 1e3 == pytest.approx(height_mm, abs=1.0)
        assert 6.0 < pitch_m(skin) * 1e3 < 8.0
        assert (skin.source.unit, skin.turned, tilted(skin)) == ("m", 0, 0)
        assert len(skin.turns) == 1
        angle = np.arctan2(skin.position_m[:, 1], skin.position_m[:, 0])
        assert angle.min() == pytest.approx(-angle.max(), abs=0.02)
        axis = skin.frame[2, :3]
        assert axis @ [0.0, 1.0, 0.0] > 0.999_999

    @pytest.mark.parametrize(("name", "missing"), [("cyskin_full", 0), ("tpu_1_full", 2)])
    def test_hexagons_are_flat(self, name, missing):
        skin = layouts.read(str(REAL / f"hexagon_{name}_isomap.json"))
        assert len(skin) + missing == 61
        assert skin.source.missing == missing
        assert math.isinf(skin.radius_m)
        assert np.ptp(skin.position_m[:, 2]) == 0.0
        assert pitch_m(skin) * 1e3 == pytest.approx(6.928, abs=0.001)


@pytest.mark.skipif(not POSITIONS.is_dir(), reason="iCub's positions are not beside this checkout")
class TestIcubPositions:
    def test_every_official_file_has_its_row(self):
        files = {file.stem for file in POSITIONS.glob("*.txt")}
        assert len(files) == 19
        assert sorted(row[0] for row in ICUB) == sorted(files)

    @pytest.mark.parametrize(("name", "counts", "radius", "own_normals"), ICUB)
    def test_official_files_are_read(self, name, counts, radius, own_normals):
        skin = layouts.read(str(POSITIONS / f"{name}.txt"))
        triangles = np.unique(skin.uid >> 4)
        boards = int(triangles.max()) // 16 + 1
        assert [len(skin), len(triangles), boards, skin.source.pads] == counts
        assert skin.source.own_normals == own_normals
        if radius in KINDS:
            assert math.isinf(skin.radius_m)
            return
        assert f"{skin.radius_m * 1e3:.1f}" == radius
        assert skin.rms_m < 0.14 * skin.radius_m
        assert skin.turned == 0
        assert tilted(skin) <= 0.13 * len(skin)

    @pytest.mark.parametrize(
        ("name", "kind"), [(name, radius) for name, _, radius, _ in ICUB if radius in KINDS]
    )
    def test_what_is_no_round_link_is_refused_with_what_it_is(self, name, kind):
        line = rf"^skin\.layout: {name}: its \d+ taxels lie on no cylinder \({KINDS[kind]}"
        with pytest.raises(SetupError, match=line):
            layouts.load(str(POSITIONS / f"{name}.txt"))

    def test_a_palms_slots_6_and_10_are_taxels(self):
        skin = layouts.read(str(POSITIONS / "left_hand_V2_1.txt"))
        assert sum(int(uid) & 0xF in THERMAL for uid in skin.uid) == 8

    @pytest.mark.parametrize("side", ["left", "right"])
    def test_both_readings_of_a_forearm_agree_on_its_cylinder(self, side):
        """One has normals of its own, the other's follow from its positions."""
        true, found = (
            layouts.load(str(POSITIONS / f"{side}_forearm_{kind}.txt"))
            for kind in ("mesh", "nomesh")
        )
        assert found.frame[2, :3] @ true.frame[2, :3] > math.cos(math.radians(5.0))
