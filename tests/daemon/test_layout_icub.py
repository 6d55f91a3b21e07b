"""iCub skin positions: every trap of the format on a small file of its own, then any input."""

import math
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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

    def test_representatives_must_be_as_many_as_rows(self, tmp_path):
        message = fault(tmp_path, icub_text(icub_rows(), [3] * 47))
        assert message.startswith("taxel2Repr: has 47 entries for 48 rows; ")

    def test_representatives_must_be_integers(self, tmp_path):
        text = icub_text(icub_rows(), [3] * 48).replace("3  3", "3  x", 1)
        assert fault(tmp_path, text).startswith("taxel2Repr: must be integers")

    def test_text_without_calibration_is_refused(self, tmp_path):
        assert fault(tmp_path, "name r_forearm\n").startswith("has no [calibration] rows")

    def test_only_zeros_hold_no_taxel(self, tmp_path):
        assert fault(tmp_path, "[calibration]\n" + "0 0 0 0 0 0\n" * 12).startswith(
            "holds 0 usable"
        )

    def test_a_file_without_true_normals_cannot_run(self, tmp_path):
        rows = ["\t".join([*row.split()[:3], "1", "0", "0"]) for row in icub_rows()]
        with pytest.raises(SetupError, match="without true normals"):
            read(tmp_path, icub_text(rows))


class TestAnyInput:
    """Reading ends in a layout or in one line; numpy's warnings would be errors here."""

    @given(st.integers(0), st.integers(0, 30), st.binary())
    @settings(max_examples=100, deadline=None)
    def test_a_stretch_of_a_good_file_overwritten(self, at, length, patch):
        content = icub_text(icub_rows(), [3] * 48).encode()
        at %= len(content)
        self.check_reading(content[:at] + patch + content[at + length :])

    @given(st.text(), st.text(alphabet="0123456789.-e \t\n()nainf[calibration]taxel2Repr"))
    @settings(max_examples=100, deadline=None)
    def test_text_of_any_kind(self, header, rows):
        self.check_reading(f"{header}[calibration]{rows}".encode("utf-8", "replace"))

    @given(st.lists(st.lists(st.floats(-10, 10), min_size=6, max_size=6), max_size=12))
    @settings(max_examples=150, deadline=None)
    def test_rows_of_any_numbers(self, rows):
        lines = "\n".join(" ".join(map(repr, row)) for row in rows)
        self.check_reading(f"[calibration]\n{lines}\n".encode())

    def check_reading(self, content: bytes) -> None:
        message = ""
        with tempfile.TemporaryDirectory() as directory:
            try:
                read(Path(directory), content)
            except SetupError as error:
                message = str(error)
        assert "\n" not in message
