"""docs/stream.md and the examples have exactly what a running daemon sends: each key, its type."""

import subprocess
import sys
import time
from enum import IntEnum
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.door.heard import as_pose
from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import client, topics, values
from tests.rig.configurations import configuration, served
from tests.rig.recorded import LiveSkin

from ..rig.stream_page import Types, documented, leaves, section

COMMANDS = ("status", "info", "tare", "reset")
PERIOD_S = 0.02  # a brisk session


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """All that a daemon sends and answers while its skin is touched, by topic and command."""
    place = tmp_path_factory.mktemp("run")
    publish = {"publish": {**served(place)["publish"], "counts": True}}
    received: dict[str, list[dict[str, Any]]] = {}
    with (
        LiveSkin(place, touches=4, period_s=PERIOD_S, rest=100) as skin,
        zmq.Context() as context,
        context.socket(zmq.SUB) as socket,
    ):
        path = configuration(place, source=skin.source, **publish)
        command = [sys.executable, "-m", "taxeld.cli", "run", str(path)]
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(f"ipc://{place}/stream")
        with subprocess.Popen(command) as daemon:
            try:
                deadline = time.monotonic() + 60.0
                while not (skin.has_ended and "info" in received):
                    assert time.monotonic() < deadline, "the skin does not end"
                    assert daemon.poll() is None
                    if socket.poll(20):
                        topic, body, _ = socket.recv_multipart()
                        received.setdefault(topic.decode(), []).append(msgpack.unpackb(body))
                    if topics.PARTICLES.decode() in received and "status" not in received:
                        for name in COMMANDS:
                            answer = client.ask(f"ipc://{place}/control", name, timeout_s=20.0)
                            assert answer is not None
                            received[name] = [answer]
                daemon.terminate()
                assert daemon.wait() == 0
            finally:
                daemon.kill()
    return received


@pytest.mark.parametrize("topic", [topic.decode() for topic in topics.TOPICS])
def test_each_message_has_the_documented_keys_and_types(
    heard: dict[str, list[dict[str, Any]]], topic: str
) -> None:
    keys, example = documented(topic)
    sent: Types = {}
    for message in heard[topic]:
        sent |= leaves(message)
        assert message.keys() == example.keys(), "every key is always there"
    unseen = keys.keys() - sent.keys()
    assert sent == {key: kind for key, kind in keys.items() if key not in unseen}
    assert all(key.endswith(("_taxels[]", "_modules[]", ".bus.*")) for key in unseen), (
        "of a recording, and of a skin that is whole, they are empty"
    )
    assert leaves(example) == keys


def test_the_commands_answer_what_is_documented(heard: dict[str, list[dict[str, Any]]]) -> None:
    part = section("control")
    for name in COMMANDS:
        (answer,) = heard[name]
        (row,) = (line for line in part.splitlines() if line.startswith(f"| `{name}`"))
        named = [text for text in row.split("|")[2].split("`") if text.isidentifier()]
        assert sorted(answer) == sorted(["ok", *named])
    assert heard["info"][0]["info"] == heard["/taxeld/info"][0]
    assert heard["status"][0]["estimate"].keys() == heard["/taxeld/estimate"][0].keys()
    assert heard["status"][0]["health"].keys() == heard["/taxeld/health"][0].keys()


def test_the_table_of_health_is_the_documented_one() -> None:
    rows = [line for line in section("/taxeld/health").splitlines() if line.startswith("| `")]
    assert rows == values.TABLE


@pytest.mark.parametrize("kind", [Status, ProposalKind, Why])
def test_every_name_of_a_number_is_documented(kind: type[IntEnum]) -> None:
    text = section("/taxeld/estimate")
    for member in kind:
        assert f"{int(member)} `{member.name.lower()}`" in text


def test_the_documented_sensor_pose_is_taken() -> None:
    keys, example = documented("/robot/sensor_pose")
    assert leaves(example) == keys
    pose = as_pose([topics.SENSOR_POSE, msgpack.packb(example), b"0.0"])
    assert pose == tuple(example[key] for key in ("t", "x", "y", "theta"))
