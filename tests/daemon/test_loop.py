"""The loop on a fake clock, and its sockets on real ones."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.config.file import load, parse
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.model.activation import Activation
from taxeld.service.loop import Daemon
from taxeld.source import session
from taxeld.stream import messages
from tests.daemon.recorded import configuration, write_session
from tests.daemon.simulated_skin import SimulatedSkin

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
        (line,) = [line for line in caplog.messages if "skin.json" in line]
        assert line.startswith(f"{state}: not used, it is ")
    finally:
        daemon.close()
    assert state.read_bytes() == before


class Heard(list[tuple[bytes, dict[str, Any]]]):
    """What a daemon sends."""

    def __init__(self, daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(daemon.link, "wants", lambda _: True)
        monkeypatch.setattr(
            daemon.link, "send", lambda topic, message, _: self.append((topic, message))
        )

    def of(self, topic: bytes) -> list[dict[str, Any]]:
        return [message for sent, message in self if sent == topic]


def test_without_scans_estimates_come_at_their_own_rate_and_with_each_change(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard = Heard(daemon, monkeypatch)
    now = time.monotonic()
    daemon.pipeline.freshness.came(now)
    sent = []
    for k in range(100):  # a second, in passes of 10 ms
        daemon.tick(now + 0.01 * k)
        sent.append(len(heard.of(messages.ESTIMATE)))
    estimates = heard.of(messages.ESTIMATE)
    assert 16 <= len(estimates) <= 22  # 20 Hz, in whole passes
    assert [e["seq"] for e in estimates] == list(range(1, len(estimates) + 1))
    statuses = [e["status"] for e in estimates]
    turned = statuses.index(Status.STALE)  # as no scan has come for so long
    assert set(statuses[:turned]) == {Status.STARTING}
    assert sent.index(turned + 1) == 51, "at once"
    daemon.pipeline.tare()
    daemon.pipeline.freshness.came(now + 1.0)
    daemon.tick(now + 1.0001)
    assert heard.of(messages.ESTIMATE)[-1]["status"] == Status.STARTING


def test_each_scan_that_is_used_has_its_estimate_however_many_come_at_once(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard, skin = Heard(daemon, monkeypatch), SimulatedSkin(daemon.layout, noise=5.0)
    skin.t = time.time() - 2.0
    scans = [skin.scan() for _ in range(35)]
    arrived = skin.t
    batches = [*([scan] for scan in scans[:25]), scans[25:32], [], scans[32:]]
    now = time.monotonic()
    for k, batch in enumerate(batches):
        monkeypatch.setattr(daemon.source, "poll", lambda *_, batch=batch, **__: batch)
        arrived = batch[-1].t if batch else arrived
        monkeypatch.setattr(time, "time", lambda arrived=arrived: arrived)
        daemon.tick(now + 0.001 * k)
    monkeypatch.undo()
    used = [e for e in heard.of(messages.ESTIMATE) if e["status"] == Status.SEARCHING]
    assert [e["t"] for e in used] == [scan.t for scan in scans[-len(used) :]]
    assert len(used) >= 14
    assert all(e["lat_us"]["skin"] > 0.0 for e in used)
    assert [e["seq"] for e in used] == [t["seq"] for t in heard.of(messages.TAXELS)][-len(used) :]


def test_what_thoughts_have_bettered_is_sent_as_another_estimate_of_the_same_scan(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard, skin = Heard(daemon, monkeypatch), SimulatedSkin(daemon.layout, noise=5.0)
    skin.t = time.time() - 9.0
    now = time.monotonic()
    monkeypatch.setattr(time, "time", lambda: skin.t)
    sent = list[list[dict[str, Any]]]()  # for each scan
    for k in range(120):
        skin.press[[33, 34]] = 8_000.0 * (k % 40 > 30)
        skin.press[[55, 56]] = 8_000.0 * (k % 80 > 60)
        scan = skin.scan()
        before = len(heard)
        for passed in range(20):
            scans = [] if passed else [scan]
            monkeypatch.setattr(daemon.source, "poll", lambda *_, scans=scans, **__: scans)
            daemon.tick(now + 0.05 * k + 0.002 * passed)
        told = [m for topic, m in heard[before:] if topic == messages.ESTIMATE]
        sent.append([e for e in told if e["t"] == scan.t])
        assert sum(topic == messages.TAXELS for topic, _ in heard[before:]) <= 1
    thought = [e for e in sent if e and e[0]["injected"] == 0 < e[-1]["injected"]]
    assert len(thought) == daemon.pipeline.estimator.counters.thoughts > 0
    for first, *_, last in thought:
        assert first["lat_us"]["skin"] > 0.0
        assert last["lat_us"]["skin"] == 0.0
        assert last["lat_us"]["filter"] > 0.0
    daemon.latencies.percentiles()
    assert daemon.latencies.scans == daemon.pipeline.skin.counters.scans, "each scan counts once"


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
        "v", "seq", "t", "uptime_s", "loop", "degraded", "lat_us", "realtime", "source", "skin",
        "estimator", "inputs", "calibration", "door", "recording", "modules", "missing_modules",
        "dead_taxels", "stuck_taxels", "saturated_taxels", "untared_taxels",
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
            track.latest_t == 1.0 and daemon.link.report.robot.malformed >= 4
        ):
            for body in bad:
                robot.send_multipart([messages.SENSOR_POSE, body, b"1.0"])
            robot.send_multipart([messages.SENSOR_POSE, good])
            robot.send_multipart([messages.SENSOR_POSE, good, b"1.0"])
            daemon.tick(time.monotonic())
            time.sleep(0.005)
    assert track.latest_t == 1.0
    assert daemon.link.report.robot.malformed >= 4
    daemon.close()


def test_taxels_say_where_the_sensor_was_or_that_nobody_knows() -> None:
    felt = Activation(5.0, np.array([0.0, 0.5]), np.array([True, True]))
    placed = messages.taxels(felt, np.array([0.1, 0.2, 0.3]), 7)
    assert placed["placed"] is True
    assert placed["sensor"] == {"x": 0.1, "y": 0.2, "theta": 0.3}
    nowhere = messages.taxels(felt, None, 7)
    assert nowhere["placed"] is False
    assert nowhere["sensor"] == {"x": 0.0, "y": 0.0, "theta": 0.0}


def test_an_endpoint_without_its_directory_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match=r"publish\.endpoints: .* does not exist"):
        Daemon(parse(settings(tmp_path / "missing")))


def test_a_replay_ends_with_its_last_scan(tmp_path: Path) -> None:
    """Though that waits for a pose that does not come."""
    write_session(tmp_path, touches=1, period_s=0.02)
    items = session.read(tmp_path).items
    times = np.arange(items[0].t, items[-1].t - 0.03, 0.01)
    rows = "".join(f"{t:.6f},0.3,0,0\n" for t in times)
    (tmp_path / session.POSES).write_text(f"t,x,y,theta\n{rows}", "ascii")
    text = "wait_s = 0.5\n"
    config = configuration(tmp_path)
    settings = config.read_text("utf-8")
    assert "[sensor_pose]" not in settings
    config.write_text(f"{settings}\n[sensor_pose]\n{text}", "utf-8")
    daemon = Daemon(load(config))
    daemon.run()
    assert daemon.counters.scans > 30
    assert daemon.pipeline.inputs.scans_waited > 0
    assert daemon.pipeline.skin.counters.scans == daemon.counters.scans


def test_a_daemon_ends_in_the_midst_of_a_touch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the skin has learned is kept, and the next life feels the touch."""
    text = settings(tmp_path) + f'[skin]\nstate_dir = "{tmp_path}/state"\n'
    daemon = Daemon(parse(text))
    skin = SimulatedSkin(daemon.layout, noise=5.0)
    skin.t = time.time() - 4.0
    now = time.monotonic()
    for k in range(60):
        skin.press[[33, 34]] = 8_000.0 * (k >= 40)
        scan = skin.scan()
        monkeypatch.setattr(daemon.source, "poll", lambda *_, scan=scan, **__: [scan])
        monkeypatch.setattr(time, "time", lambda: skin.t)
        daemon.tick(now + 0.05 * k, left_s=0.0)  # so each pass does one part
        if daemon.pipeline.is_at_work:
            break
    assert daemon.pipeline.is_at_work
    daemon.close()
    monkeypatch.undo()
    again = Daemon(parse(text))
    again.close()
