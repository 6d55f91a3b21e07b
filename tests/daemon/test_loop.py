"""The loop on a fake clock, and its sockets on real ones."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.config.file import parse
from taxeld.errors import SetupError
from taxeld.service.loop import Daemon
from taxeld.stream import messages

EVERY_KEY = [
    *("v", "seq", "t", "mono_ns", "valid", "status", "contact", "contacts", "map", "mean", "cov"),
    *("modes", "ess", "particles", "injected", "proposal", "log_evidence", "age_us", "overruns"),
    *("degraded", "lat_us"),
]


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    made = Daemon(parse(settings(tmp_path)))
    yield made
    made.close()


def settings(place: Path) -> str:
    return (
        f'[source]\nkind = "can"\ninterface = "virtual"\nchannel = "{place.name}"\n'
        f'[scene]\nbundle = "box"\n[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n'
    )


def subscribe(context: zmq.Context[Any], place: Path, topic: bytes) -> zmq.Socket[Any]:
    socket = context.socket(zmq.SUB)
    socket.setsockopt(zmq.LINGER, 0)
    socket.connect(f"ipc://{place}/stream")
    socket.setsockopt(zmq.SUBSCRIBE, topic)
    return socket


def receive(daemon: Daemon, socket: zmq.Socket[Any]) -> list[bytes]:
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        daemon.tick(time.monotonic())
        if socket.poll(5):
            parts: list[bytes] = socket.recv_multipart()
            return parts
    raise AssertionError("nothing was published")


def test_estimates_are_what_plotjuggler_plots(daemon: Daemon, tmp_path: Path) -> None:
    """Topic, one map of plain types with string keys and no trailing bytes, a time in text."""
    with zmq.Context() as context, subscribe(context, tmp_path, messages.ESTIMATE) as socket:
        topic, body, stamp = receive(daemon, socket)
    assert topic == b"/taxeld/estimate"
    message = msgpack.unpackb(body)
    assert list(message) == EVERY_KEY
    assert plain(message)
    assert float(stamp) >= 0.0
    assert stamp.decode().split(".")[1].isdigit()
    assert message["status"] == 0
    assert not message["valid"]
    assert list(message["lat_us"]) == ["source", "skin", "propose", "filter", "publish", "total"]


def plain(value: object) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(map(plain, value))
    return isinstance(value, (bool, int, float))


@pytest.mark.parametrize("time_of", ["9" * 400, "9" * 5000, "[" * 2000])
def test_a_daemon_starts_without_a_skin_state_that_is_damaged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, time_of: str
) -> None:
    state = tmp_path / "skin.json"
    state.write_text(f'{{"version": 1, "t": {time_of}}}', encoding="ascii")
    before = state.read_bytes()
    daemon = Daemon(parse(settings(tmp_path) + f'[skin]\nstate_dir = "{tmp_path}"\n'))
    try:
        daemon.tick(time.monotonic())
        assert daemon.kept.counters.refused == 1
        (line,) = [line for line in caplog.messages if "skin.json" in line]
        assert line.startswith(f"{state}: not used, it is ")
    finally:
        daemon.close()
    assert state.read_bytes() == before


def test_every_new_subscriber_gets_the_info_message(daemon: Daemon, tmp_path: Path) -> None:
    with zmq.Context() as context:
        for _ in range(2):
            with subscribe(context, tmp_path, b"/taxeld/") as socket:
                topics = set()
                while messages.INFO not in topics:
                    topic, body, _ = receive(daemon, socket)
                    topics.add(topic)
                info = msgpack.unpackb(body)
                assert info["layout"]["taxels"] == 80
                assert info["status"]["3"] == "converged"
                assert len(info["config_hash"]) == 16


def test_health_counts_and_names_the_dead(daemon: Daemon, tmp_path: Path) -> None:
    with zmq.Context() as context, subscribe(context, tmp_path, messages.HEALTH) as socket:
        health = msgpack.unpackb(receive(daemon, socket)[1])
    assert set(health) == {
        "v", "seq", "t", "uptime_s", "loop", "over_budget", "degraded", "realtime", "source",
        "skin", "skin_state", "estimator", "inputs", "control", "recording", "subscribers",
        "hoarders", "keys_refused", "lat_us", "belief", "drift", "dead_taxels", "stuck_taxels",
        "saturated_taxels", "untared_taxels", "calibration",
    }  # fmt: skip
    assert health["source"]["frames"] == 0


def ask(daemon: Daemon, socket: zmq.Socket[Any], body: bytes) -> dict[str, Any]:
    socket.send(body)
    deadline = time.monotonic() + 10.0
    while not socket.poll(5) and time.monotonic() < deadline:
        daemon.tick(time.monotonic())
    answer: dict[str, Any] = msgpack.unpackb(socket.recv())
    return answer


def test_control_answers_and_survives_nonsense(daemon: Daemon, tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(f"ipc://{tmp_path}/control")
        assert ask(daemon, socket, msgpack.packb({"cmd": "status"}))["estimate"]["status"] == 0
        for command in ("tare", "reset"):
            assert ask(daemon, socket, msgpack.packb({"cmd": command})) == {"ok": True}
        for nonsense in (b"", b"\xc1", b"junk", msgpack.packb([1]), msgpack.packb({"cmd": 7})):
            answer = ask(daemon, socket, nonsense)
            assert not answer["ok"]
            assert "known: status, info, tare, reset" in answer["error"]


def test_a_client_that_breaks_off_does_not_wedge_control(daemon: Daemon, tmp_path: Path) -> None:
    with zmq.Context() as context:
        for _ in range(3):
            with context.socket(zmq.REQ) as socket:
                socket.setsockopt(zmq.LINGER, 0)
                socket.connect(f"ipc://{tmp_path}/control")
                socket.send(msgpack.packb({"cmd": "status"}))  # and is gone
        with context.socket(zmq.REQ) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(f"ipc://{tmp_path}/control")
            assert ask(daemon, socket, msgpack.packb({"cmd": "status"}))["ok"]


def test_malformed_sensor_poses_are_counted(tmp_path: Path) -> None:
    text = settings(tmp_path) + f'[sensor_pose]\nendpoint = "ipc://{tmp_path}/poses"\n'
    daemon = Daemon(parse(text))
    assert daemon.pose_input is not None
    good = msgpack.packb({"t": 1.0, "x": 0, "y": 0.5, "theta": 0.0})
    with zmq.Context() as context, context.socket(zmq.PUB) as robot:
        robot.setsockopt(zmq.LINGER, 0)
        robot.bind(f"ipc://{tmp_path}/poses")
        deadline = time.monotonic() + 10.0
        track = daemon.pipeline.poses
        bad = [
            b"",
            msgpack.packb({"t": 1.0}),
            msgpack.packb({"t": "x", "x": 0, "y": 0, "theta": 0}),
        ]
        while time.monotonic() < deadline and not (
            track.latest_t == 1.0 and daemon.pose_input.counters.malformed >= 4
        ):
            for body in bad:
                robot.send_multipart([messages.SENSOR_POSE, body, b"1.0"])
            robot.send_multipart([messages.SENSOR_POSE, good])
            robot.send_multipart([messages.SENSOR_POSE, good, b"1.0"])
            daemon.tick(time.monotonic())
            time.sleep(0.005)
    assert track.latest_t == 1.0
    assert daemon.pose_input.counters.malformed >= 4
    daemon.close()


def test_an_endpoint_without_its_directory_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match=r"publish\.endpoints: .* does not exist"):
        Daemon(parse(settings(tmp_path / "missing")))
