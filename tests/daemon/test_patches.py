"""Patches of touch: groups, places on the skin, and numbers that last."""

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.skin.patches import PATCHES_MAX, Patches
from taxeld.stream import messages

from ..rig.skins import SKIN

DEPTH_M = 0.005
COLUMNS = 16
PITCH_M = 0.015


def pressed(layout: Layout, *at: int, z: float = 0.5) -> Floats:
    found = np.zeros(len(layout))
    found[list(at)] = z
    return found


def flat(rows: int = 8, columns: int = 8) -> Layout:
    """A flat pad, on no cylinder."""
    y, x = np.mgrid[:rows, :columns] * 0.01
    place = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    normal = np.tile([0.0, 0.0, 1.0], (x.size, 1))
    return Layout("pad", np.arange(x.size), place, normal, np.inf)


def test_touching_neighbours_are_one_patch_and_others_are_not() -> None:
    patches = Patches(SKIN, DEPTH_M)
    found = patches.on_scan(pressed(SKIN, 0, COLUMNS - 1, COLUMNS + 1, 40, 8))
    assert sorted(one.taxels.tolist() for one in found) == [[0, 15, 17], [8], [40]]


def test_a_patch_on_a_cylinder_lies_on_it_between_its_taxels_weighted_by_activation() -> None:
    z = pressed(SKIN, 34, 35)
    z[35] = 1.0
    (one,) = Patches(SKIN, DEPTH_M).on_scan(z)
    assert np.hypot(*one.position_m[:2]) == pytest.approx(SKIN.radius_m)
    angle = np.degrees(np.arctan2(one.position_m[1], one.position_m[0]))
    assert angle == pytest.approx((2 + 2 / 3) * 22.5, abs=0.5)
    assert one.normal @ one.position_m == pytest.approx(SKIN.radius_m, rel=1e-3)
    assert (one.sum, one.peak, one.depth_m) == pytest.approx((1.5, 1.0, DEPTH_M))
    assert one.area_m2 == pytest.approx(2 * PITCH_M**2, rel=0.1)


def test_a_patch_on_no_cylinder_lies_on_its_surface() -> None:
    pad = flat()
    (one,) = Patches(pad, DEPTH_M).on_scan(pressed(pad, 0, 1, 8, 9))
    assert one.position_m == pytest.approx([0.005, 0.005, 0.0])
    assert one.normal == pytest.approx([0.0, 0.0, 1.0])
    assert one.area_m2 == pytest.approx(4e-4)


def test_two_sides_of_a_thin_plate_are_two_patches() -> None:
    pad = flat()
    place = np.concatenate([pad.position_m, pad.position_m - [0.0, 0.0, 0.002]])
    plate = Layout(
        "plate", np.arange(128), place, np.concatenate([pad.normal, -pad.normal]), np.inf
    )
    assert len(Patches(plate, DEPTH_M).on_scan(pressed(plate, 9, 64 + 9))) == 2


def test_pressed_all_around_a_link_the_strongest_taxel_tells_place_and_normal() -> None:
    z = pressed(SKIN, *range(2 * COLUMNS, 3 * COLUMNS))
    z[36] = 0.6
    (one,) = Patches(SKIN, DEPTH_M).on_scan(z)
    assert one.position_m.tolist() == SKIN.position_m[36].tolist()
    assert one.normal.tolist() == SKIN.normal[36].tolist()


def test_a_patch_keeps_its_number_while_it_slides_and_a_new_one_gets_another() -> None:
    patches = Patches(SKIN, DEPTH_M)
    ids = [
        [one.id for one in patches.on_scan(pressed(SKIN, *at))]
        for at in ((34, 35), (35, 36), (36, 37), (), (36, 37))
    ]
    assert ids == [[1], [1], [1], [], [2]]


def test_of_patches_that_meet_and_part_the_larger_keeps_its_number() -> None:
    patches = Patches(SKIN, DEPTH_M)
    small, large = [33], [35, 36, 37]
    first = {len(one.taxels): one.id for one in patches.on_scan(pressed(SKIN, *small, *large))}
    (met,) = patches.on_scan(pressed(SKIN, *small, 34, *large))
    assert met.id == first[3]
    parted = {len(one.taxels): one.id for one in patches.on_scan(pressed(SKIN, *small, *large))}
    assert parted[3] == first[3]
    assert parted[1] not in first.values()


def test_no_more_than_a_bound_are_told_and_the_rest_is_counted() -> None:
    pad = flat(12, 12)
    z = np.zeros((12, 12))
    z[::2, ::2] = np.arange(1, 37).reshape(6, 6) / 36
    patches = Patches(pad, DEPTH_M)
    found = patches.on_scan(z.ravel())
    assert len(found) == PATCHES_MAX
    assert patches.left_out == 36 - PATCHES_MAX
    assert min(one.sum for one in found) == pytest.approx((36 - PATCHES_MAX + 1) / 36)


def test_a_patch_is_told_in_the_world_as_well() -> None:
    patches = Patches(SKIN, DEPTH_M)
    patches.on_scan(pressed(SKIN, 2 * COLUMNS))  # at angle 0
    said = messages.contacts(5.0, patches, np.array([1.0, 2.0, np.pi / 2]), 7)
    (one,) = said["patches"]
    assert one["position"] == pytest.approx({"x": 0.04, "y": 0.0, "z": 0.0})
    assert one["world_position"] == pytest.approx({"x": 1.0, "y": 2.04, "z": 0.0})
    assert one["world_normal"] == pytest.approx({"x": 0.0, "y": 1.0, "z": 0.0})
    assert messages.contacts(5.0, patches, None, 7)["placed"] is False
