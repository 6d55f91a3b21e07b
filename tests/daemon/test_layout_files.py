"""robotskinlib files: every trap of the format on a small file of its own."""

import dataclasses
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.source.sources import live
from taxeld_protocol.array import ArrayDecoder
from taxeld_protocol.modules import NAMES
from tests.rig.skins import table_of

RADIUS_M = 0.05


def taxel(i: int) -> dict[str, Any]:
    """Taxel i of 8 columns over half a circle about the file's y axis, module 3 + i // 10."""
    angle, row = math.pi * (i % 8) / 7, i // 8
    n = [math.cos(angle), 0.0, math.sin(angle)]
    x = [RADIUS_M * n[0], 0.1 + 0.008 * row, RADIUS_M * n[2]]
    return {"id": (3 + i // 10) << 4 | (i % 10 + 1), "x": x, "n": n, "type": "pressure", "cut": 0}


def document(taxels: int = 40) -> dict[str, Any]:
    return {
        "info": {"file_version": "2", "type": "rigid_body", "name": "link"},
        "skin": {
            "n_taxels": taxels,
            "n_faces": 0,
            "parent_frames": [
                {"key": 0, "tf_matrix": [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0.1, 0.2, 0.3, 1]}
            ],
            "taxels": [taxel(i) for i in range(taxels)],
            "faces": [],
        },
    }


class Folder:
    def __init__(self, path: Path) -> None:
        self.path = path

    def load(self, content: Any) -> Layout:
        file = self.path / "skin.json"
        file.write_text(json.dumps(content), encoding="utf-8")
        return layouts.load(str(file))

    def fault(self, content: Any) -> str:
        """What is said of a document, without the path."""
        with pytest.raises(SetupError) as caught:
            self.load(content)
        message, prefix = str(caught.value), f"skin.layout: {self.path}/skin.json: "
        assert "\n" not in message
        assert message.startswith(prefix)
        return message.removeprefix(prefix)


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    return Folder(tmp_path)


class TestRobotskinlib:
    def test_taxels_come_in_file_order_in_the_sensor_frame(self, folder):
        skin = folder.load(document())
        assert skin.name == "skin"
        assert skin.uid.tolist() == [taxel(i)["id"] for i in range(40)]
        assert skin.radius_m == pytest.approx(RADIUS_M)
        assert skin.rms_m < 1e-9
        np.testing.assert_allclose(
            skin.position_m[:, 2], np.repeat(range(-2, 3), 8) * 0.008, atol=1e-12
        )
        outwards = skin.position_m * [1 / RADIUS_M, 1 / RADIUS_M, 0]
        np.testing.assert_allclose(skin.normal, outwards, atol=1e-12)

    def test_frame_takes_the_files_positions_to_the_sensor(self, folder):
        skin = folder.load(document())
        there = np.array([[*taxel(i)["x"], 1.0] for i in range(40)]) @ skin.frame.T
        np.testing.assert_allclose(there[:, :3], skin.position_m, atol=1e-12)
        np.testing.assert_allclose(skin.frame[:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(skin.frame[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)

    def test_tf_matrix_is_column_major(self, folder):
        parent = folder.load(document()).source.parent
        expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
        np.testing.assert_allclose(parent, expected)

    def test_tf_matrix_row_by_row_is_refused(self, folder):
        wrong = document()
        frame = wrong["skin"]["parent_frames"][0]
        frame["tf_matrix"] = np.reshape(frame["tf_matrix"], (4, 4)).T.ravel().tolist()
        message = folder.fault(wrong)
        assert message.startswith("skin.parent_frames[0].tf_matrix: ")
        assert "transpose" in message

    @pytest.mark.parametrize("frames", [None, [], [{"key": 0}], {}])
    def test_parent_frame_may_be_absent(self, folder, frames):
        file = document()
        file["skin"]["parent_frames"] = frames
        assert folder.load(file).source.parent is None

    def test_millimetres_are_told_by_the_extent(self, folder):
        file = document()
        for t in file["skin"]["taxels"]:
            t["x"] = [1e3 * v for v in t["x"]]
        matrix = file["skin"]["parent_frames"][0]["tf_matrix"]
        matrix[12:15] = [1e3 * v for v in matrix[12:15]]
        metres, skin = folder.load(document()), folder.load(file)
        assert (metres.source.unit, skin.source.unit) == ("m", "mm")
        np.testing.assert_allclose(skin.position_m, metres.position_m, atol=1e-12)
        np.testing.assert_allclose(skin.source.parent, metres.source.parent)

    @pytest.mark.parametrize(
        ("changes", "left", "missing_cut_duplicates"),
        [
            ({4: {"id": -1, "x": None}, 9: {"id": -1}}, 38, (2, 0, 0)),
            ({4: {"id": 3 << 4}, 5: {"type": "temperature"}}, 38, (2, 0, 0)),
            ({4: {"cut": 1}, 5: {"cut": 7}}, 38, (0, 2, 0)),
            ({9: {"id": taxel(4)["id"]}}, 39, (0, 0, 1)),
            ({4: {"id": taxel(9)["id"], "cut": 1}}, 39, (0, 1, 0)),
        ],
        ids=["missing", "temperature", "cut", "duplicate", "cut one of a live one's id"],
    )
    def test_an_entry_that_is_no_taxel_is_left_out_and_counted(
        self, folder, changes, left, missing_cut_duplicates
    ):
        file = document()
        for i, change in changes.items():
            file["skin"]["taxels"][i].update(change)
        skin = folder.load(file)
        source = skin.source
        assert len(skin) == left
        assert (source.missing, source.cut, source.duplicates) == missing_cut_duplicates
        assert set(skin.uid.tolist()) <= {taxel(i)["id"] for i in range(40)}

    def test_of_duplicates_the_first_counts(self, folder):
        file = document()
        file["skin"]["taxels"][9]["id"] = taxel(4)["id"]
        skin = folder.load(file)
        place = skin.frame[:3, :3].T @ (skin.position_m[4] - skin.frame[:3, 3])
        np.testing.assert_allclose(place, taxel(4)["x"], atol=1e-12)

    @pytest.mark.parametrize(
        "change",
        [
            lambda file: file.update(tactile_maps=[]),
            lambda file: file.update(tactile_maps=[{"taxels": [{"id": 1}]}]),
            lambda file: file.update(tactile_maps={"taxels": []}),
            lambda file: file["info"].update(file_version=2),
            lambda file: [t.update(n=[-v for v in t["n"]]) for t in file["skin"]["taxels"]],
            lambda file: [t.update(n=[0.3 * v for v in t["n"]]) for t in file["skin"]["taxels"]],
        ],
        ids=["no maps", "maps", "a map", "version", "inward normals", "short normals"],
    )
    def test_what_files_write_in_several_ways_gives_the_same_skin(self, folder, change):
        file = document()
        change(file)
        skin = folder.load(file)
        assert skin.digest == folder.load(document()).digest
        assert skin.turned in (0, 40)

    def test_taxels_may_be_grouped_in_lists(self, folder):
        file = document()
        taxels = file["skin"]["taxels"]
        file["skin"]["taxels"] = [taxels[:15], taxels[15:]]
        assert folder.load(file).digest == folder.load(document()).digest
        taxels[17]["x"] = 5
        file["skin"]["taxels"] = [taxels[:15], taxels[15:]]
        assert folder.fault(file).startswith("skin.taxels[1][2].x: must be 3 numbers, not 5; ")

    @pytest.mark.parametrize(
        ("where", "value", "words"),
        [
            (("id",), None, "skin.taxels[12].id: must be a UID, or -1 for missing, not None"),
            (("id",), True, "skin.taxels[12].id: "),
            (("id",), "53777", "skin.taxels[12].id: "),
            (("id",), -2, "skin.taxels[12].id: "),
            (("id",), 1 << 36, "skin.taxels[12].id: "),
            (("id",), 3 << 4 | NAMES, "skin.taxels[12].id: 60 is taxel 12 of its module"),
            (("cut",), "no", "skin.taxels[12].cut: must be 0"),
            (("x",), [0.1, 0.2], "skin.taxels[12].x: must be 3 numbers, not [0.1, 0.2]; "),
            (("x",), [0.1, 0.2, "0"], "skin.taxels[12].x: "),
            (("x", 1), math.nan, "skin.taxels[12].x: "),
            (("x", 1), math.inf, "skin.taxels[12].x: "),
            (("x", 1), 10**400, "skin.taxels[12].x: "),
            (("x", 1), True, "skin.taxels[12].x: "),
            (("n",), [0, 0, 0], "skin.taxels[12].n: the normal must not be zero; "),
            (("n",), [1e-300, 0, 0], "skin.taxels[12].n: the normal must not be zero; "),
            (("x", 1), 9e5, "taxels span "),
        ],
    )
    def test_a_fault_in_a_taxel_names_its_place_and_the_cure(self, folder, where, value, words):
        file = document()
        at = file["skin"]["taxels"][12]
        for key in where[:-1]:
            at = at[key]
        at[where[-1]] = value
        message = folder.fault(file)
        assert message.startswith(words)
        if where[0] in ("x", "n"):
            assert "; correct " in message

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            ([], "info: must be an object"),
            ({}, "info: must be an object"),
            ({"info": {"file_version": 2}}, "skin: must be an object"),
            ({"info": {"file_version": 1}, "skin": {}}, "info.file_version: must be 2, not 1"),
            ({"info": {"file_version": 2}, "skin": {}}, "skin.taxels: must be a list"),
            ({"info": {"file_version": 2}, "skin": {"taxels": []}}, "holds 0 usable taxels"),
            ({"info": {"file_version": 2}, "skin": {"taxels": [1]}}, "skin.taxels[0]: must be"),
        ],
    )
    def test_other_json_is_refused_by_name(self, folder, content, words):
        assert folder.fault(content).startswith(words)

    @pytest.mark.parametrize(
        ("content", "words"),
        [
            (b"", "is not JSON"),
            (b"{", "is not JSON"),
            (b"[" * 100_000, "is nested too deeply"),
            (b'{"info": ' + b"1" * 5000 + b"}", "is not JSON"),
            (b"\x80PNG", "is not UTF-8 text"),
        ],
    )
    def test_a_file_that_is_no_json_is_one_line(self, tmp_path, content, words):
        file = tmp_path / "skin.json"
        file.write_bytes(content)
        with pytest.raises(SetupError, match=words):
            layouts.load(str(file))

    @pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo])
    def test_a_directory_or_a_pipe_is_no_layout(self, tmp_path, make):
        make(tmp_path / "skin.json")
        with pytest.raises(SetupError, match="it is no regular file"):
            layouts.load(str(tmp_path / "skin.json"))

    def test_a_flat_patch_can_be_read_but_not_run(self, tmp_path):
        file = document()
        for t in file["skin"]["taxels"]:
            t.update(x=[t["x"][0], t["x"][1], 0.02], n=[0, 0, -1])
        path = tmp_path / "patch.json"
        path.write_text(json.dumps(file), encoding="utf-8")
        flat = layouts.read(str(path))
        assert math.isinf(flat.radius_m)
        assert math.isnan(flat.rms_m)
        np.testing.assert_allclose(flat.normal, [[0, 0, 1]] * 40)
        np.testing.assert_allclose(flat.position_m[:, 2], 0.0, atol=1e-12)
        with pytest.raises(SetupError, match=r"skin\.layout: patch: its 40 taxels lie on no cyl"):
            layouts.load(str(path))


RING = layouts.load("cylinder:rows=3,columns=16,radius_m=0.05,pitch_m=0.01")


class TestTable:
    """A plain table, a row a taxel."""

    @pytest.mark.parametrize("uid", [False, True])
    def test_a_table_has_the_taxels_of_the_layout_that_was_written(self, tmp_path, uid):
        own = dataclasses.replace(RING, uid=RING.uid + 160 * uid)
        file = tmp_path / "own.csv"
        file.write_text(table_of(own, uid=uid), encoding="ascii")
        found = layouts.load(str(file))
        assert (found.name, found.radius_m) == ("own", pytest.approx(0.05, abs=1e-5))
        np.testing.assert_array_equal(found.uid, own.uid)
        turn, shift = found.frame[:3, :3], found.frame[:3, 3]
        np.testing.assert_allclose(found.position_m, own.position_m @ turn.T + shift, atol=2e-6)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda _: "", "line 1: must be uid,x,y,z,nx,ny,nz; uid or the n… may lack"),
            (lambda text: text.replace("nx", "a"), "line 1: must be uid,x,y,z,nx,ny,nz; uid"),
            (lambda text: text.partition("\n")[0], "holds 0 usable taxels"),
            (lambda text: text.replace("0.05", "wide", 1), "line 2: must be 6 numbers, not ['wide"),
            (lambda text: text.replace(",17\n", "\n", 1), "line 2: '0.000000' is no UID"),
            (lambda text: text.replace(",17\n", ",18\n", 1), "line 3: '18' is no UID, or one for"),
            (
                lambda text: text.replace("0.050000", "nan", 1),
                "line 2: must be 6 numbers, not [nan",
            ),
            (lambda text: text.replace(",17\n", ",-1\n", 1), "line 2: '-1' is no UID"),
        ],
    )
    def test_a_fault_in_a_table_names_its_line(self, tmp_path, change, words):
        file = tmp_path / "own.csv"
        file.write_text(change(table_of(RING, uid=True)), encoding="ascii")
        with pytest.raises(SetupError) as caught:
            layouts.read(str(file))
        assert str(caught.value).startswith(f"skin.layout: {file}: {words}")

    def test_a_table_without_normals_has_those_of_its_cylinder(self, tmp_path):
        file = tmp_path / "own.csv"
        rows = [",".join(map(repr, map(float, place))) for place in RING.position_m]
        lines = [f"{100 - i},{row}" for i, row in enumerate(rows)]
        file.write_text("uid,x,y,z\n" + "\n".join(lines) + "\n", encoding="ascii")
        found = layouts.load(str(file))
        assert found.uid.tolist() == [100 - i for i in range(len(RING))]
        assert found.radius_m == pytest.approx(0.05, abs=1e-4)
        radial = found.position_m * (1.0, 1.0, 0.0) / 0.05
        assert np.einsum("ij,ij->i", found.normal, radial).min() > 0.999, "outwards"

    def test_uids_that_no_module_has_are_of_arrays_alone(self):
        own = dataclasses.replace(RING, uid=np.arange(len(RING)))
        ArrayDecoder(own.uid.tolist())
        with pytest.raises(
            SetupError, match=r"skin\.layout: its UIDs are of no module.*of an array"
        ):
            live(SourceConfig(kind="can"), own)
