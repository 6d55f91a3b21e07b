"""A daemon without an object: it serves the skin alone."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from taxeld.commands import check, status
from taxeld.commands.replay import replay
from taxeld.config.file import load
from taxeld.stream import topics
from tests.rig.configurations import configuration
from tests.rig.recorded import LiveSkin, Said, said_of, write_session

from ..rig.stream_page import documented, leaves

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
