"""The layout value: numbering, digest, turns; generated layouts; the cylinder fit; the command."""

import math
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from taxeld.cli import main
from taxeld.commands.layout import arc_rad, pitch_m, tilted
from taxeld.errors import SetupError
from taxeld.layout import cylinder_fit
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld_protocol.modules import wired
from tests.rig.commands import printed, refused

DEFAULT = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
WRAP = "wrap:modules=12,radius_m=0.04,rows=2"


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return points @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def arc(degrees: float, radius_m: float = 0.07, rows: int = 8, columns: int = 20):
    """Positions and outward normals of a regular patch about z, centred on angle 0."""
    angle = np.radians(np.tile(np.linspace(-degrees / 2, degrees / 2, columns), rows))
    height = np.repeat(np.arange(rows) * 0.008, columns)
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    return radius_m * normal + height[:, None] * [0.0, 0.0, 1.0], normal


class TestCylinder:
    def test_digest_of_the_default_is_the_one_bundles_refer_to(self):
        assert layouts.load(DEFAULT).digest == "cc915a300678428f"

    def test_taxels_are_numbered_row_by_row_from_below_and_counter_clockwise(self):
        skin = layouts.load(DEFAULT)
        for i, (x, y, z) in enumerate(skin.position_m):
            row, column = divmod(i, 16)
            angle = 2 * math.pi * column / 16
            assert z == pytest.approx((row - 2) * 0.015)
            assert (x, y) == pytest.approx((0.04 * math.cos(angle), 0.04 * math.sin(angle)))
        np.testing.assert_allclose(
            skin.normal * [0.04, 0.04, 1] + skin.position_m * [0, 0, 1], skin.position_m, atol=1e-15
        )

    def test_uid_is_module_and_name_ten_taxels_a_module(self):
        skin = layouts.load("cylinder:rows=1,columns=23,radius_m=0.04,pitch_m=0.015")
        assert skin.uid.tolist() == [((i // 10 + 1) << 4) | (i % 10 + 1) for i in range(23)]
        modules = wired(skin.uid.tolist())
        assert [(m.sui, m.mask) for m in modules] == [(1, 0x7FF), (2, 0x7FF), (3, 0xF)]

    def test_frame_is_the_identity(self):
        np.testing.assert_array_equal(layouts.load(DEFAULT).frame, np.eye(4))


class TestTurns:
    @pytest.mark.parametrize(("spec", "order"), [(DEFAULT, 16), (WRAP, 6)])
    def test_turned_reading_is_the_reading_of_the_turned_touch(self, spec, order):
        skin = layouts.load(spec)
        assert skin.turns.shape == (order, len(skin))
        for k, turn in enumerate(skin.turns):
            there = turned(skin.position_m, 2 * math.pi * k / order)
            np.testing.assert_allclose(skin.position_m[turn], there, atol=1e-12)

    @pytest.mark.parametrize("spec", [DEFAULT, WRAP])
    def test_sector_is_the_turn_that_brings_a_taxel_to_angle_0(self, spec):
        skin = layouts.load(spec)
        order = len(skin.turns)
        for p, k in zip(skin.position_m, skin.sector, strict=True):
            x, y, _ = turned(p, -2 * math.pi * k / order)
            assert abs(math.atan2(y, x)) <= math.pi / order + 1e-9

    def test_are_found_fast_on_a_full_hub(self):
        skin = layouts.load("cylinder:rows=31,columns=80,radius_m=0.1,pitch_m=0.01")
        began = time.process_time()
        assert len(skin.turns) == 80
        assert time.process_time() - began < 2.0

    def test_a_taxel_out_of_place_breaks_the_symmetry(self):
        skin = layouts.load(DEFAULT)
        moved = skin.position_m.copy()
        moved[7, 2] += 0.001
        bent = Layout("bent", skin.uid, moved, skin.normal, skin.radius_m)
        assert len(bent.turns) == 1
        assert not bent.sector.any()

    def test_taxels_at_one_place_have_no_symmetry(self):
        skin = layouts.load(DEFAULT)
        twice = np.repeat([0], 80)
        same = Layout("same", skin.uid, skin.position_m[twice], skin.normal[twice], 0.04)
        assert len(same.turns) == 1


class TestWrap:
    def test_triangle_is_the_measured_one(self):
        skin = layouts.load(WRAP)
        x = np.arctan2(skin.position_m[:10, 1], skin.position_m[:10, 0]) * 40.0
        z = skin.position_m[:10, 2] * 1e3
        relative = np.column_stack([x, z]) - [x[9], z[9]]
        t = [(12, 5.657), (4, 5.657), (-4, 5.657), (-12, 5.657), (-8, 0), (-4, -5.657),
             (0, -11.314), (4, -5.657), (8, 0), (0, 0)]  # fmt: skip
        np.testing.assert_allclose(relative, t, atol=1e-9)

    def test_next_module_stands_on_its_head(self):
        z = layouts.load(WRAP).position_m[:, 2].reshape(2, 12, 10)
        below = z[0] - z[0].mean()
        np.testing.assert_allclose(below[0], below[2], atol=1e-15)
        np.testing.assert_allclose(z[0, 1] - z[0, 1, 9], z[0, 0, 9] - z[0, 0], atol=1e-15)
        np.testing.assert_allclose(z[1, 0] - z[1, 0, 9], z[0, 0, 9] - z[0, 0], atol=1e-15)

    def test_uid_is_module_and_name(self):
        uid = layouts.load(WRAP).uid
        assert uid.tolist() == [sui << 4 | name for sui in range(1, 25) for name in range(1, 11)]

    def test_taxels_of_all_modules_keep_their_distance(self):
        skin = layouts.load("wrap:modules=22,radius_m=0.0701,rows=4")
        assert pitch_m(skin) == pytest.approx(0.006928, abs=5e-5)
        gap = np.linalg.norm(skin.position_m[:, None] - skin.position_m, axis=-1)
        assert (gap + np.eye(len(skin))).min() > 0.0065

    def test_rows_are_centred_and_default_to_one(self):
        for spec in (WRAP, "wrap:modules=12,radius_m=0.04"):
            z = layouts.load(spec).position_m[:, 2]
            assert z.min() == pytest.approx(-z.max())


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("", "no known layout"),
        ("sphere:rows=1", "no known layout"),
        ("skin.xml", "no known layout"),
        ("cylinder", "no known layout"),
        ("cylinder:", "unknown cylinder key"),
        ("cylinder:rows=5", "lacks columns, pitch_m, radius_m"),
        ("cylinder:rows=5,row=6", "unknown cylinder key 'row'"),
        ("cylinder:rows=five", "rows=<int>"),
        ("cylinder:rows=0,columns=16,radius_m=0.04,pitch_m=0.015", "must be 1..2480"),
        ("cylinder:rows=99,columns=99,radius_m=0.04,pitch_m=0.015", "must be 1..2480"),
        ("cylinder:rows=5,columns=16,radius_m=nan,pitch_m=0.015", "positive lengths"),
        ("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=-1", "positive lengths"),
        ("wrap:modules=11,radius_m=0.1", "must be even"),
        ("wrap:modules=12,radius_m=0.1,rows=0", "rows 1 or more"),
        ("wrap:modules=12,radius_m=0.03", "at least 0.0382"),
        ("wrap:modules=250,radius_m=2", "at most 248"),
        ("wrap:modules=12,radius_m=inf", "positive lengths"),
        ("nowhere/skin.json", "no such file"),
        ("x" * 5000 + ".json", "unreadable"),
        ("\0.txt", "skin.layout"),
    ],
)
def test_text_that_is_no_layout_is_one_line_with_the_cure(spec, words):
    with pytest.raises(SetupError) as caught:
        layouts.load(spec)
    message = str(caught.value)
    assert message.startswith("skin.layout: ")
    assert words in message
    assert "\n" not in message


class TestFit:
    def test_finds_an_arc_wherever_it_stands_in_the_file(self):
        position, normal = arc(180.0)
        turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
        turn *= np.linalg.det(turn)
        found = cylinder_fit.fit(position @ turn.T + [0.3, -0.2, 1.0], normal @ turn.T)
        assert found.radius_m == pytest.approx(0.07, abs=1e-9)
        rotation, shift = found.frame[:3, :3], found.frame[:3, 3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        there = (position @ turn.T + [0.3, -0.2, 1.0]) @ rotation.T + shift
        np.testing.assert_allclose(np.hypot(*there[:, :2].T), 0.07, atol=1e-9)

    def test_origin_is_at_mid_height_and_x_points_to_the_middle_of_an_arc(self):
        position, normal = arc(120.0)
        found = cylinder_fit.fit(position + np.array([0.5, 0.0, 0.0]), normal)
        expected = np.eye(4)
        expected[:3, 3] = -0.5, 0.0, -0.028
        np.testing.assert_allclose(found.frame, expected, atol=1e-9)

    def test_a_full_turn_keeps_the_files_own_axis_as_angle_0(self):
        position, normal = arc(360.0 * 19 / 20)
        found = cylinder_fit.fit(position, normal)
        np.testing.assert_allclose(found.frame[0, :3], [1.0, 0.0, 0.0], atol=1e-9)
        cycled = cylinder_fit.fit(np.roll(position, 1, axis=1), np.roll(normal, 1, axis=1))
        np.testing.assert_allclose(
            cycled.frame[:3, :3] @ np.eye(3)[:, [1, 2, 0]], np.eye(3), atol=1e-9
        )

    def test_half_a_circle_with_noise_does_not_shrink(self):
        position, normal = arc(180.0)
        rng = np.random.default_rng(0)
        found = [
            cylinder_fit.fit(position + off * normal, normal).radius_m
            for off in 0.003 * rng.standard_normal((50, len(position), 1))
        ]
        assert np.mean(found) == pytest.approx(0.07, abs=0.0005)

    def test_tells_which_normals_point_inwards(self):
        position, normal = arc(180.0)
        normal[::3] *= -1.0
        found = cylinder_fit.fit(position, normal)
        assert found.inwards.tolist() == [i % 3 == 0 for i in range(len(normal))]
        assert found.frame[0, 0] == pytest.approx(1.0)

    @pytest.mark.parametrize("what", ["flat", "point", "line", "blob", "dome"])
    def test_says_so_where_there_is_no_cylinder(self, what):
        position, normal = arc(180.0)
        rng = np.random.default_rng(0)
        if what == "flat":
            position, normal = position * [0, 1, 1], np.tile([1.0, 0.0, 0.0], (len(normal), 1))
        elif what == "point":
            position = np.zeros_like(position)
        elif what == "line":
            position = position * [0.0, 1.0, 0.0]
        elif what == "blob":
            position = 0.05 * rng.standard_normal(position.shape)
        else:
            normal = rng.standard_normal(normal.shape)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            normal[:, 2] = np.abs(normal[:, 2])
            position = 0.05 * normal
        found = cylinder_fit.fit(position, normal)
        assert math.isinf(found.radius_m)
        assert np.isfinite(found.frame).all()


class TestSummary:
    def test_arc_is_what_the_taxels_cover(self):
        for degrees in (90.0, 178.0, 270.0):
            position, normal = arc(degrees)
            skin = Layout("arc", np.arange(len(normal)), position, normal, 0.07)
            assert math.degrees(arc_rad(skin)) == pytest.approx(degrees)
        assert arc_rad(layouts.load(DEFAULT)) == 2.0 * math.pi

    def test_pitch_leaves_out_taxels_at_the_same_place(self):
        position, normal = arc(180.0)
        twice = np.repeat(np.arange(len(normal)), 2)
        skin = Layout("pairs", twice, position[twice], normal[twice], 0.07)
        assert pitch_m(skin) == pytest.approx(0.008)

    def test_tilted_normals_are_counted(self):
        position, normal = arc(180.0)
        normal[0] = turned(normal[0], math.radians(35.0))
        normal[1] = turned(normal[1], math.radians(25.0))
        normal[2] = 0.0, 0.0, 1.0
        skin = Layout("tilted", np.arange(len(normal)), position, normal, 0.07)
        assert tilted(skin) == 2


class TestCommand:
    def test_prints_every_fact_and_draws(self, tmp_path: Path):
        out = tmp_path / "skin.png"
        text = printed("layout", DEFAULT, "--png", out)
        for word in (
            "80 in 8 modules",
            "0 missing, 0 cut, 0 duplicate",
            "metres",
            "40.0 mm",
            "360.0°",
            "60.0 mm",
            "15.00 mm",
            "order 16",
            "cc915a300678428f",
        ):
            assert word in text
        assert out.read_bytes().startswith(b"\x89PNG")

    def test_a_picture_that_cannot_be_written_is_one_line(self, tmp_path: Path, capsys):
        assert main(["layout", WRAP, "--png", str(tmp_path / "no" / "skin.png")]) == 2
        assert capsys.readouterr().err.count("\n") == 1

    def test_without_matplotlib_the_cure_is_the_view_extra(self, monkeypatch, capsys):
        monkeypatch.delitem(sys.modules, "taxeld.layout.draw", raising=False)
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        assert main(["layout", WRAP, "--png", "skin.png"]) == 2
        error = capsys.readouterr().err
        assert "-m pip install" in error
        assert "matplotlib" in error
        assert error.count("\n") == 1

    def test_a_wrong_layout_is_exit_2(self):
        refused("layout", "sphere:")
