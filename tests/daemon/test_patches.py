"""Patches of touch: groups, places on the skin, and numbers that last."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.commands import check, status
from taxeld.commands.replay import replay
from taxeld.config.file import load
from taxeld.layout.layout import Layout
from taxeld.skin.patches import PATCHES_MAX, Patches
from taxeld.stream import messages, topics
from tests.rig.configurations import configuration
from tests.rig.recorded import LiveSkin, Said, said_of, write_session

from ..rig.skins import SKIN
from ..rig.stream_page import documented, leaves

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
    found = Patches(SKIN, DEPTH_M).on_scan(pressed(SKIN, 0, COLUMNS - 1, COLUMNS + 1, 40, 8))
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


NO_SCENE: dict[str, Any] = {"scene": {}}
LOADED = "import sys; from taxeld import cli; cli.main(); print(*sys.modules)"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Said, list[str]]:
    """What a daemon sends and answers while its skin is touched twice; and the modules that it has
    loaded."""
    place, contacts = tmp_path_factory.mktemp("alone"), topics.CONTACTS.decode()
    asks = dict.fromkeys(("status", "info", "reset"), contacts)
    with LiveSkin(place, touches=2) as skin:
        path = configuration(place, source=skin.source, **NO_SCENE)
        command = [sys.executable, "-c", LOADED, "run", str(path)]
        done = lambda said: sum(not m["patches"] for m in said[contacts]) == 2  # noqa: E731
        said, printed = said_of(place, command, asks, done)
    return said, printed.split()


def test_taxels_contacts_health_and_info_are_sent_and_no_estimate(
    ran: tuple[Said, list[str]],
) -> None:
    said, modules = ran
    told = topics.TAXELS, topics.CONTACTS, topics.HEALTH, topics.INFO
    assert {topic for topic in said if topic.startswith("/")} == {topic.decode() for topic in told}
    (info,) = said["info"]
    assert (info["info"]["object"], info["info"]["objects"]) == ("", [])
    assert info["info"].keys() == documented("/taxeld/info")[1].keys()
    assert said["/taxeld/health"][-1].keys() == documented("/taxeld/health")[1].keys()
    assert "taxeld.service.loop" in modules
    assert "onnxruntime" not in modules


def test_a_patch_is_told_while_it_is_pressed_and_its_end_once(ran: tuple[Said, list[str]]) -> None:
    said, _ = ran
    ids = [[one["id"] for one in m["patches"]] for m in said["/taxeld/contacts"]]
    assert ids == [[1]] * 10 + [[]] + [[2]] * 10 + [[]]
    assert leaves(said["/taxeld/contacts"][0]) == documented("/taxeld/contacts")[0]


def test_it_answers_that_there_is_no_object(ran: tuple[Said, list[str]]) -> None:
    said, _ = ran
    lines = list(status.lines(said["status"][0]))
    assert "no object is configured" in lines[1]
    assert not any(line.startswith(("Pose ", "Modes", "Contacts")) for line in lines)
    assert not said["reset"][0]["ok"]
    assert said["reset"][0]["error"].endswith("nothing to forget")


def test_check_says_that_nothing_will_be_estimated_and_replay_tells_contacts(
    tmp_path: Path,
) -> None:
    write_session(tmp_path, touches=1)
    whole = load(configuration(tmp_path, **NO_SCENE))
    assert check.faults(whole) == []
    assert check.notes(whole) == [check.ALONE]
    lines = list(replay(tmp_path, whole))
    said = [json.loads(line) for line in lines]
    assert [len(m["patches"]) for m in said[24:36]] == [0, *[1] * 10, 0]
    assert lines == list(replay(tmp_path, whole))
