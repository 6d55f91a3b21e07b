"""docs/stream.md and the examples have exactly what a running daemon sends: each key, its type."""

from enum import IntEnum

import msgpack
import pytest

from taxeld.door.heard import as_pose
from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics, values
from tests.rig.configurations import configuration, served
from tests.rig.processes import TAXELD
from tests.rig.recorded import LiveSkin, Said, said_of

from ..rig.stream_page import Types, documented, leaves, section

COMMANDS = ("status", "info", "tare", "reset")
PERIOD_S = 0.02  # a brisk session


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Said:
    """All that a daemon sends and answers while its skin is touched."""
    place = tmp_path_factory.mktemp("run")
    publish = {"publish": {**served(place)["publish"], "counts": True}}
    asks = dict.fromkeys(COMMANDS, topics.PARTICLES.decode())
    with LiveSkin(place, touches=4, period_s=PERIOD_S, rest=100) as skin:
        path = configuration(place, source=skin.source, **publish)
        done = lambda said: skin.has_ended and said["info"]  # noqa: E731
        return said_of(place, [*TAXELD, "run", str(path)], asks, done)[0]


@pytest.mark.parametrize("topic", [topic.decode() for topic in topics.TOPICS])
def test_each_message_has_the_documented_keys_and_types(heard: Said, topic: str) -> None:
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


def test_the_commands_answer_what_is_documented(heard: Said) -> None:
    part = section("control")
    for name in COMMANDS:
        (answer,) = heard[name]
        (row,) = (line for line in part.splitlines() if line.startswith(f"- `{name}`"))
        named = [text for text in row.partition(": ")[0].split("`")[2:] if text.isidentifier()]
        assert sorted(answer) == sorted(["ok", *named])
    assert heard["info"][0]["info"] == heard["/taxeld/info"][0]
    assert heard["status"][0]["estimate"].keys() == heard["/taxeld/estimate"][0].keys()
    assert heard["status"][0]["health"].keys() == heard["/taxeld/health"][0].keys()


def test_the_table_of_health_is_the_documented_one() -> None:
    rows = [line for line in section("/taxeld/health").splitlines() if line.startswith("- `")]
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
