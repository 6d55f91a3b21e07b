"""The layout value: numbering, digest, turns; generated layouts; the cylinder fit; the command."""

import math
import re

import numpy as np
import pytest

from taxeld.commands.layout import pitch_m, tilted
from taxeld.errors import SetupError
from taxeld.layout import fit
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld_protocol.modules import wired
from tests.rig.commands import printed

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


def test_a_cylinders_taxels_go_row_by_row_from_below_and_counter_clockwise():
    skin = layouts.load(DEFAULT)
    assert (skin.digest, skin.name) == ("cc915a300678428f", DEFAULT), "bundles refer to it"
    row, angle = np.divmod(np.arange(80), 16) * np.array([[1.0], [2 * math.pi / 16]])
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    place = 0.04 * normal + (row[:, None] - 2) * [0.0, 0.0, 0.015]
    np.testing.assert_allclose(skin.position_m, place, atol=1e-15)
    np.testing.assert_allclose(skin.normal, normal, atol=1e-15)
    assert (skin.frame == np.eye(4)).all()


@pytest.mark.parametrize("sui", [1, 9])
def test_uid_is_module_and_name_ten_taxels_a_module_and_changes_no_bundle(sui):
    spec = "cylinder:rows=1,columns=23,radius_m=0.04,pitch_m=0.015"
    skin = layouts.load(f"{spec},sui={sui}")
    assert skin.uid.tolist() == [((i // 10 + sui) << 4) | (i % 10 + 1) for i in range(23)]
    modules = [(m.sui, m.mask) for m in wired(skin.uid.tolist())]
    assert modules == [(sui, 0x7FF), (sui + 1, 0x7FF), (sui + 2, 0xF)]
    assert skin.digest == layouts.load(spec).digest


TRIANGLE_MM = [(12, 5.657), (4, 5.657), (-4, 5.657), (-12, 5.657), (-8, 0), (-4, -5.657),
               (0, -11.314), (4, -5.657), (8, 0), (0, 0)]  # fmt: skip


def test_a_wraps_triangle_is_the_measured_one_and_the_next_stands_on_its_head():
    skin = layouts.load(WRAP)
    x = np.arctan2(skin.position_m[:10, 1], skin.position_m[:10, 0]) * 40.0
    z = skin.position_m[:, 2].reshape(2, 12, 10) * 1e3
    relative = np.column_stack([x - x[9], z[0, 0] - z[0, 0, 9]])
    np.testing.assert_allclose(relative, TRIANGLE_MM, atol=1e-9)
    up = z - z[:, :, 9:]
    heads = [up[0, 1], up[1, 0], -up[0, 2]]
    np.testing.assert_allclose(heads, np.tile(-up[0, 0], (3, 1)), atol=1e-12)
    assert skin.uid.tolist() == [s << 4 | name for s in range(1, 25) for name in range(1, 11)]


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_a_wraps_taxels_keep_their_distance_and_are_centred(rows):
    skin = layouts.load(f"wrap:modules=22,radius_m=0.0701,rows={rows}")
    assert skin.position_m[:, 2].min() == pytest.approx(-skin.position_m[:, 2].max())
    assert pitch_m(skin) == pytest.approx(0.006928, abs=5e-5)
    gap = np.linalg.norm(skin.position_m[:, None] - skin.position_m, axis=-1)
    assert (gap + np.eye(len(skin))).min() > 0.0065


@pytest.mark.parametrize(
    ("spec", "order"),
    [
        (DEFAULT, 16),
        (WRAP, 6),
        ("cylinder:rows=31,columns=80,radius_m=0.1,pitch_m=0.01", 80),  # a full hub
    ],
)
def test_a_turned_reading_is_the_reading_of_the_turned_touch(spec, order):
    skin = layouts.load(spec)
    assert skin.turns.shape == (order, len(skin))
    for k, turn in enumerate(skin.turns):
        there = turned(skin.position_m, 2 * math.pi * k / order)
        np.testing.assert_allclose(skin.position_m[turn], there, atol=1e-12)
    for p, k in zip(skin.position_m, skin.sector, strict=True):
        x, y, _ = turned(p, -2 * math.pi * k / order)
        assert abs(math.atan2(y, x)) <= math.pi / order + 1e-9


def test_a_taxel_out_of_place_or_two_at_one_place_break_the_symmetry():
    skin = layouts.load(DEFAULT)
    moved = skin.position_m.copy()
    moved[7, 2] += 0.001
    for position in (moved, skin.position_m[np.zeros(80, int)]):
        bent = Layout("bent", skin.uid, position, skin.normal, skin.radius_m)
        assert len(bent.turns) == 1
        assert not bent.sector.any()


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("", "no known layout"),
        ("sphere:rows=1", "no known layout"),
        ("ur.jsn", "ur.jsn: unreadable (No such file"),
        (__file__, "no known layout"),
        ("cylinder", "no known layout"),
        ("cylinder:", "unknown key; known: rows, columns, radius_m, pitch_m, sui"),
        ("cylinder:rows=5", "columns: is required; use 'cylinder:rows=5,columns=16,rad"),
        ("cylinder:rows=5,row=6", "row: unknown key; did you mean rows?"),
        (DEFAULT.replace("rows=5", "rows=five"), "rows: must be an integer, not 'five'"),
        (DEFAULT.replace("rows=5", "rows=0"), "rows: must be 1..2480, not 0"),
        (DEFAULT.replace("rows=5", "rows=999"), "rows × columns must be 1..2480"),
        (DEFAULT.replace("0.04", "nan"), "radius_m: must be a number, not nan"),
        (DEFAULT.replace("0.015", "-1"), "pitch_m: must be 1e-06..10, not -1"),
        ("wrap:modules=11,radius_m=0.1", "modules: must be even, as they alternate, not 11"),
        ("wrap:modules=12,radius_m=0.03", "radius_m: must be at least 0.0382 for 12 modules"),
        ("wrap:modules=248,radius_m=2,rows=2", "modules × rows: must be at most 248"),
        ("nowhere/skin", "nowhere/skin: unreadable (No such file"),
        ("x" * 5000 + ".json", "unreadable"),
        ("\0.txt", ""),
    ],
)
def test_text_that_is_no_layout_is_one_line_with_the_cure(spec, words):
    with pytest.raises(SetupError, match=rf"^skin\.layout: [^\n]*{re.escape(words)}[^\n]*$"):
        layouts.load(spec)


def test_a_full_turn_keeps_the_files_own_axis_as_angle_0():
    position, normal = arc(360.0 * 19 / 20)
    found = fit.cylinder(position, normal)
    np.testing.assert_allclose(found.frame[0, :3], [1.0, 0.0, 0.0], atol=1e-9)
    cycled = fit.cylinder(np.roll(position, 1, axis=1), np.roll(normal, 1, axis=1))
    np.testing.assert_allclose(cycled.frame[:3, :3] @ np.eye(3)[:, [1, 2, 0]], np.eye(3), atol=1e-9)


def test_a_fit_of_half_a_circle_with_noise_does_not_shrink():
    position, normal = arc(180.0)
    rng = np.random.default_rng(0)
    found = [
        fit.cylinder(position + off * normal, normal).radius_m
        for off in 0.003 * rng.standard_normal((50, len(position), 1))
    ]
    assert np.mean(found) == pytest.approx(0.07, abs=0.0005)


@pytest.mark.parametrize("what", ["flat", "point", "line", "blob", "dome"])
def test_a_fit_says_so_where_there_is_no_cylinder(what):
    position, normal = arc(180.0)
    rng = np.random.default_rng(0)
    up = np.abs(rng.standard_normal(normal.shape))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    position, normal = {
        "flat": (position * [0, 1, 1], np.tile([1.0, 0.0, 0.0], (len(normal), 1))),
        "point": (0.0 * position, normal),
        "line": (position * [0.0, 1.0, 0.0], normal),
        "blob": (0.05 * rng.standard_normal(position.shape), normal),
        "dome": (0.05 * up, up),
    }[what]
    found = fit.cylinder(position, normal)
    assert (found.radius_m, bool(found.why_none)) == (math.inf, True)
    assert np.isfinite(found.frame).all()


def test_pitch_leaves_out_taxels_at_the_same_place_and_tilted_normals_are_counted():
    position, normal = arc(180.0)
    for i, angle in ((0, 35.0), (1, 25.0)):
        normal[i] = turned(normal[i], math.radians(angle))
    normal[2] = 0.0, 0.0, 1.0
    twice = np.repeat(np.arange(len(normal)), 2)
    skin = Layout("pairs", twice, position[twice], normal[twice], 0.07)
    assert pitch_m(skin) == pytest.approx(0.008)
    assert tilted(skin) == 4


def test_the_command_prints_every_fact():
    text, facts = (
        printed("layout", DEFAULT),
        (
            *("80 in 8 modules", "0 missing, 0 cut, 0 duplicate", "metres", "40.0 mm", "360.0°"),
            *("60.0 mm", "15.00 mm", "order 16", "cc915a300678428f"),
        ),
    )
    assert [fact for fact in facts if fact not in text] == []
