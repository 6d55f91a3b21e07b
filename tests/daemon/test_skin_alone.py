"""A daemon without an object: it serves the skin alone."""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.cli import main
from taxeld.commands import check, status
from taxeld.commands.replay import replay
from taxeld.config.file import load, parse
from taxeld.config.gate import ConfigError
from taxeld.config.tables import SkinConfig
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals.samples import Samples
from taxeld.stream import client, topics
from tests.rig.configurations import config, configuration
from tests.rig.recorded import LiveSkin, write_session
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import SKIN

from ..rig.stream_page import documented, leaves

NO_SCENE: dict[str, Any] = {"scene": {}}
LOADED = "import sys; from taxeld import cli; cli.main(); print(*sys.modules)"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """What a daemon sends and answers while its skin is touched twice, by topic and command; and
    the modules that it has loaded."""
    place = tmp_path_factory.mktemp("alone")
    received: dict[str, list[Any]] = {topics.CONTACTS.decode(): []}
    with (
        LiveSkin(place, touches=2) as skin,
        zmq.Context() as context,
        context.socket(zmq.SUB) as socket,
    ):
        path = configuration(place, source=skin.source, **NO_SCENE)
        command = [sys.executable, "-c", LOADED, "run", str(path)]
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(f"ipc://{place}/stream")
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as daemon:
            try:
                deadline = time.monotonic() + 60.0
                while sum(not m["patches"] for m in received[topics.CONTACTS.decode()]) < 2:
                    assert time.monotonic() < deadline, "it does not feel both touches"
                    if socket.poll(20):
                        topic, body, _ = socket.recv_multipart()
                        received.setdefault(topic.decode(), []).append(msgpack.unpackb(body))
                    if "status" not in received and received[topics.CONTACTS.decode()]:
                        for name in ("status", "info", "reset"):
                            answer = client.ask(f"ipc://{place}/control", name, timeout_s=20.0)
                            received[name] = [answer]
                daemon.terminate()
                out, _ = daemon.communicate()
            finally:
                daemon.kill()
    received["modules"] = out.split()
    return received


def test_taxels_contacts_health_and_info_are_sent_and_no_estimate(
    ran: dict[str, list[Any]],
) -> None:
    sent = {topic for topic in ran if topic.startswith("/")}
    told = topics.TAXELS, topics.CONTACTS, topics.HEALTH, topics.INFO
    assert sent == {topic.decode() for topic in told}
    (info,) = ran["info"]
    assert (info["info"]["object"], info["info"]["objects"]) == ("", [])
    assert info["info"].keys() == documented("/taxeld/info")[1].keys()
    assert ran["/taxeld/health"][-1].keys() == documented("/taxeld/health")[1].keys()


def test_a_patch_is_told_while_it_is_pressed_and_its_end_once(ran: dict[str, list[Any]]) -> None:
    ids = [[one["id"] for one in m["patches"]] for m in ran["/taxeld/contacts"]]
    assert ids == [[1]] * 10 + [[]] + [[2]] * 10 + [[]]
    assert leaves(ran["/taxeld/contacts"][0]) == documented("/taxeld/contacts")[0]


def test_it_answers_that_there_is_no_object_and_loads_no_sampler(
    ran: dict[str, list[Any]],
) -> None:
    lines = list(status.lines(ran["status"][0]))
    assert "no object is configured" in lines[1]
    assert not any(line.startswith(("Pose ", "Modes", "Contacts")) for line in lines)
    assert not ran["reset"][0]["ok"]
    assert ran["reset"][0]["error"].endswith("nothing to forget")
    assert "taxeld.service.loop" in ran["modules"]
    assert "onnxruntime" not in ran["modules"]


def test_a_session_without_an_object_is_replayed_as_its_contacts(tmp_path: Path) -> None:
    write_session(tmp_path, touches=1)
    whole = load(configuration(tmp_path, **NO_SCENE))
    lines = list(replay(tmp_path, whole))
    said = [json.loads(line) for line in lines]
    assert [len(m["patches"]) for m in said[24:36]] == [0, *[1] * 10, 0]
    assert lines == list(replay(tmp_path, whole))


def test_keys_that_need_an_object_are_refused_by_name() -> None:
    tables = {"filter": {"particles": 50, "seed": 0}}
    with pytest.raises(ConfigError) as caught:
        config(scene={}, **tables)
    named = [fault.split(":")[0] for fault in caught.value.faults]
    assert named == ["filter.particles"]


def test_check_notes_that_nothing_will_be_estimated(tmp_path: Path) -> None:
    write_session(tmp_path)
    whole = load(configuration(tmp_path, **NO_SCENE))
    assert check.faults(whole) == []
    assert check.notes(whole) == [check.ALONE]


def test_init_writes_a_configuration_without_an_object(tmp_path: Path) -> None:
    path = tmp_path / "skin.toml"
    layout = SkinConfig().layout
    assert main(["init", str(path), "--source", "can:can0", "--layout", layout]) == 0
    written = load(path)
    assert (written.scene.names, written.skin.layout) == ((), layout)


def test_each_of_several_links_is_served() -> None:
    text = '[source]\nkind = "can"\nchannel = "can0"\n' + "[[skin]]\n" * 2
    server = Pipeline(parse(text), [SKIN, SKIN], [], Samples())
    skins = [SimulatedSkin(SKIN, seed=k) for k in range(2)]
    for scan in range(30):
        skins[1].press[40] = 9000.0 * (scan >= 25)
        scans = [replace(skin.scan(), link=k) for k, skin in enumerate(skins)]
        outcomes = list(server.advance(scans, skins[0].t))
    felt = {one.link: one.activation for one in outcomes}
    assert [felt[k] is not None and felt[k].z.any() for k in range(2)] == [False, True]  # type: ignore[union-attr]
    assert server.estimate.contact
