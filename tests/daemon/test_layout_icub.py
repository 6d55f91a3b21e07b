"""iCub skin positions: every trap of the format on a small file of its own, then any input."""

import math
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.layout import summary
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout

RADIUS_M = 0.05


def icub_rows(slots: int = 48) -> list[str]:
    """Rows of 12-slot triangles around half a circle, thermal pads 6 and 10 all zero."""
    rows = []
    for i in range(slots):
        angle, thermal = math.pi * i / (slots - 1), i % 12 in (6, 10)
        n = [0.0, math.cos(angle), math.sin(angle)]
        x = [0.001 * (i % 7), RADIUS_M * n[1], RADIUS_M * n[2]]
        rows.append("\t".join(f"{0.0 if thermal else v:.6f}" for v in x + n))
    return rows


def full_rows(slots: int = 48) -> list[str]:
    """All twelve slots of each triangle around half a circle."""
    rows = []
    for i in range(slots):
        angle = math.pi * i / (slots - 1)
        y, z = math.cos(angle), math.sin(angle)
        rows.append(f"{0.001 * (i % 7):.6f} {RADIUS_M * y:.6f} {RADIUS_M * z:.6f} 0 {y} {z}")
    return rows


def dense_rows() -> list[str]:
    """Half a cylinder, 10 rows of 24 taxels."""
    places = [(0.006 * (i // 24), math.pi * (i % 24) / 23) for i in range(240)]
    return [
        f"{x} {RADIUS_M * math.cos(a)} {RADIUS_M * math.sin(a)} 0 {math.cos(a)} {math.sin(a)}"
        for x, a in places
    ]


def icub_text(rows: list[str], representative: list[int] | None = None) -> str:
    header = "name    r_forearm\nspatial_sampling     taxel\n"
    if representative is not None:
        header += f"taxel2Repr (  {'  '.join(map(str, representative))}  )\n"
    return header + "[calibration]\n" + "\n".join(rows) + "\n\n"


def read(folder: Path, text: str | bytes) -> Layout:
    file = folder / "skin.txt"
    file.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "replace"))
    return layouts.load(str(file))


def fault(folder: Path, text: str | bytes) -> str:
    """What is said of a file that is none, without the path."""
    with pytest.raises(SetupError) as caught:
        read(folder, text)
    message, prefix = str(caught.value), f"skin.layout: {folder}/skin.txt: "
    assert "\n" not in message
    assert message.startswith(prefix)
    return message.removeprefix(prefix)


class TestPositions:
    def test_uid_is_triangle_and_slot(self, tmp_path):
        skin = read(tmp_path, icub_text(icub_rows()))
        slots = [i for i in range(48) if i % 12 not in (6, 10)]
        assert skin.uid.tolist() == [i // 12 << 4 | i % 12 for i in slots]
        assert skin.radius_m == pytest.approx(RADIUS_M, abs=1e-5)

    def test_rows_of_zeros_are_absent(self, tmp_path):
        rows = icub_rows()
        rows[13] = " 0.000  0.000  0.000 -0.000 -0.000 -0.000"
        assert read(tmp_path, icub_text(rows)).source.missing == 9

    def test_negative_representative_is_no_taxel(self, tmp_path):
        representative = [3 if i < 24 else -2 for i in range(48)]
        skin = read(tmp_path, icub_text(icub_rows(), representative))
        assert (len(skin), skin.source.missing) == (20, 28)
        assert skin.uid.max() >> 4 == 1

    def test_representatives_may_run_over_lines(self, tmp_path):
        text = icub_text(icub_rows(), [3] * 48).replace("3  3", "3\n 3")
        assert len(read(tmp_path, text)) == 40

    def test_taxels_may_share_a_place(self, tmp_path):
        rows = icub_rows()
        rows[1] = rows[2] = rows[0]
        assert len(read(tmp_path, icub_text(rows))) == 40

    @pytest.mark.parametrize(
        ("row", "words"),
        [
            ("0.1 0.2 0.3", "line 9: must be 6 numbers"),
            ("0.1 0.2 0.3 0 0 one", "line 9: must be 6 numbers"),
            ("0.1 0.2 nan 0 0 1", "line 9: must be 6 numbers"),
            ("0.1 0.2 1e9 0 0 1", "line 9: must be 6 numbers"),
            ("0.1 0.2 0.3 0 0 0", "line 9: the normal must not be zero"),
        ],
    )
    def test_a_fault_in_a_row_names_its_line(self, tmp_path, row, words):
        rows = icub_rows()
        rows[4] = row
        assert fault(tmp_path, icub_text(rows, [3] * 48)).startswith(words)

    @pytest.mark.parametrize("entries", [36, 47, 49, 960])
    def test_rows_count_and_surplus_or_missing_representatives_do_not(self, tmp_path, entries):
        """Official files list 960 entries for 384, 768 or 1344 rows."""
        representative = [3 if i % 12 not in (6, 10) else -2 for i in range(entries)]
        skin = read(tmp_path, icub_text(icub_rows(), representative))
        assert (len(skin), skin.source.missing, skin.source.pads) == (40, 8, 8)

    def test_representatives_must_be_integers(self, tmp_path):
        text = icub_text(icub_rows(), [3] * 48).replace("3  3", "3  x", 1)
        assert fault(tmp_path, text).startswith("taxel2Repr: must be integers")

    def test_text_without_calibration_is_refused(self, tmp_path):
        assert fault(tmp_path, "name r_forearm\n").startswith("has no [calibration] rows")

    def test_only_zeros_hold_no_taxel(self, tmp_path):
        assert fault(tmp_path, "[calibration]\n" + "0 0 0 0 0 0\n" * 12).startswith(
            "holds 0 usable"
        )

    @pytest.mark.parametrize("normal", [(0, 0, 0), (1, 0, 0), (0, 0.5, 0)])
    def test_where_a_file_tells_no_normals_its_positions_do(self, tmp_path, normal):
        """Official files have none, or the same for all taxels of a round link."""
        true = read(tmp_path, icub_text(dense_rows()))
        rows = [" ".join([*row.split()[:3], *map(str, normal)]) for row in dense_rows()]
        skin = read(tmp_path, icub_text(rows))
        assert true.source.own_normals
        assert not skin.source.own_normals
        assert skin.radius_m == pytest.approx(RADIUS_M, rel=0.01)
        np.testing.assert_allclose(skin.position_m, true.position_m, atol=1e-3)
        assert (np.einsum("ij,ij->i", skin.normal, true.normal) > 0.95).all()
        assert "normals   found from the positions, 0 turned outwards" in "\n".join(summary(skin))

    @pytest.mark.parametrize("normal", [(0, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, -1)])
    def test_a_flat_patch_is_flat_whatever_its_normals_say(self, tmp_path, normal):
        places = [(0.01 * (1 + i % 8), 0.01 * (i // 8), 0.0) for i in range(36)]
        rows = [" ".join(map(str, place + normal)) for place in places]
        file = tmp_path / "skin.txt"
        file.write_text(icub_text(rows))
        skin = layouts.read(str(file))
        assert np.ptp(skin.position_m[:, 2]) < 1e-12
        np.testing.assert_allclose(skin.normal, [[0, 0, 1]] * 36, atol=1e-12)
        with pytest.raises(SetupError, match=r"its 36 taxels lie on no cylinder \(they lie flat\)"):
            layouts.load(str(file))

    def test_one_row_without_a_normal_among_others_is_a_fault(self, tmp_path):
        rows = icub_rows()
        rows[4] = "0.1 0.2 0.3 0 0 0"
        assert fault(tmp_path, icub_text(rows)).startswith("line 8: the normal must not be zero")


class TestThermalPads:
    """Which slots are pads follows from the file."""

    def test_slots_6_and_10_of_a_common_triangle_are_pads_though_the_file_lists_them(
        self, tmp_path
    ):
        """`*_forearm_mesh` gives all twelve slots the triangle's own middle, slot 3."""
        own = [12 * (i // 12) + 3 for i in range(48)]
        skin = read(tmp_path, icub_text(full_rows(), own))
        assert (len(skin), skin.source.missing, skin.source.pads) == (40, 8, 8)
        assert {int(uid) & 0xF for uid in skin.uid} == set(range(12)) - {6, 10}

    @pytest.mark.parametrize("middle", [9, 5])
    def test_slots_6_and_10_are_taxels_where_another_slot_is_the_middle(self, tmp_path, middle):
        """A fingertip, and a palm, whose triangles are of their own kind."""
        own = [12 * (i // 12) + middle for i in range(48)]
        skin = read(tmp_path, icub_text(full_rows(), own))
        assert (len(skin), skin.source.pads) == (48, 0)

    def test_slots_6_and_10_are_taxels_where_several_taxels_stand_for_a_triangle(self, tmp_path):
        palm = [99 if i % 12 < 6 else 101 for i in range(48)]
        palm[11] = palm[23] = -1
        skin = read(tmp_path, icub_text(full_rows(), palm))
        assert (len(skin), skin.source.pads) == (46, 2)
        assert {6, 10} <= {int(uid) & 0xF for uid in skin.uid}

    def test_a_pad_that_has_a_place_is_no_taxel(self, tmp_path):
        """`torso` and `*_arm_mesh` say where their pads are."""
        marked = [-2 if i % 12 in (6, 10) else 12 * (i // 12) + 3 for i in range(48)]
        skin = read(tmp_path, icub_text(full_rows(), marked))
        assert (len(skin), skin.source.pads) == (40, 8)

    def test_a_taxel_without_a_place_is_missing_and_no_pad(self, tmp_path):
        rows, own = icub_rows(), [12 * (i // 12) + 3 for i in range(48)]
        rows[0] = "0 0 0 0 0 0"
        skin = read(tmp_path, icub_text(rows, own))
        assert (skin.source.missing, skin.source.pads) == (9, 8)
        assert "9 missing (8 thermal pads), 0 cut" in "\n".join(summary(skin))

    def test_a_triangle_that_is_not_there_has_no_pads(self, tmp_path):
        rows = [*icub_rows(36), *["0 0 0 0 0 0"] * 12]
        skin = read(tmp_path, icub_text(rows, [12 * (i // 12) + 3 for i in range(36)] + [-1] * 12))
        assert (skin.source.missing, skin.source.pads) == (18, 6)
