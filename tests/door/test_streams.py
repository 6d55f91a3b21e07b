"""Subscribers at the door: newcomers, the slow, the silent, and those who send too much."""

import contextlib
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from zmq.auth import create_certificates, load_certificate

from taxeld.stream import client, curve, topics
from taxeld.stream.sockets import open_socket

from ..rig.commands import refuses
from ..rig.processes import attacked, free_port, resident_bytes
from ..rig.sockets import Sockets
from .stand import ANYWHERE, INFO, QUEUE, Stand, pid, pose, robots_endpoint, seq


@pytest.fixture(params=["ipc", "tcp"])
def stand(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stand]:
    """`stand.stream` is the endpoint of that kind, `stand.other` of the other."""
    with Stand(tmp_path, relay_publish=(f"tcp://127.0.0.1:{free_port()}",)) as made:
        if request.param == "tcp":
            made.stream, made.other = made.other, made.stream
        yield made


def test_each_subscriber_to_info_is_told_who_speaks_and_no_other(stand: Stand) -> None:
    other = stand.listener(b"/taxeld/estimate", b"/taxeld/information", b"/robot/")
    for prefix in (b"", b"/taxeld/info"):
        heard = stand.listener(prefix)
        while (parts := stand.received(heard))[0] != topics.INFO:
            pass
        assert msgpack.unpackb(parts[1]) == INFO
        assert float(parts[2]) == pytest.approx(time.time(), abs=60.0)
    for _ in range(100):  # again and again
        heard.setsockopt(zmq.UNSUBSCRIBE, topics.INFO)
        heard.setsockopt(zmq.SUBSCRIBE, topics.INFO)
    stand.received(heard)
    for _ in range(20):
        assert stand.received(other)[0] == topics.ESTIMATE


def test_the_loop_knows_which_topics_somebody_wants(stand: Stand) -> None:
    wants = stand.link.wants
    assert not any(map(wants, topics.TOPICS))
    first, second = (stand.listener(topics.TAXELS, b"/taxeld/p") for _ in range(2))
    stand.until(lambda: wants(topics.TAXELS) and wants(topics.PARTICLES))
    assert not wants(topics.HEALTH)
    stand.received(stand.listener(topics.INFO))  # the second is heard as well by now
    first.close()
    third = stand.listener(topics.COUNTS)
    stand.until(lambda: wants(topics.COUNTS))
    assert wants(topics.TAXELS)
    second.close()
    stand.until(lambda: not (wants(topics.TAXELS) or wants(topics.PARTICLES)))
    assert wants(topics.COUNTS)
    third.close()


@pytest.mark.parametrize("end", [b"\x00", b""])
def test_no_peer_ends_the_topic_of_another(stand: Stand, end: bytes) -> None:
    honest = stand.listener(topics.TAXELS)
    stand.until(lambda: stand.link.wants(topics.TAXELS))
    stranger = stand.socket(zmq.XSUB, stand.stream)
    for said in (b"\x01" + topics.PARTICLES, end + topics.TAXELS, b"\x01" + topics.HEALTH):
        stranger.send(said)
    stand.until(lambda: stand.link.wants(topics.HEALTH))
    assert stand.link.wants(topics.TAXELS)
    stranger.close()
    stand.until(lambda: not stand.link.wants(topics.PARTICLES))
    stand.link.send(topics.TAXELS, {"z": []}, 1.0)
    stand.received(honest)


@pytest.mark.check
def test_a_slow_subscriber_keeps_a_bounded_number_and_loses_the_rest_alone(stand: Stand) -> None:
    stalled = stand.listener(b"/taxeld/e", RCVHWM=1, RCVBUF=4096)
    reading = stand.listener(b"/taxeld/e")
    stand.received(stalled)
    stand.received(reading)
    body, sent = {"blob": "x" * 700}, 1000
    for number in range(sent):
        stand.link.send(topics.ESTIMATE, body | {"number": number}, 1.0)
        while msgpack.unpackb(stand.received(reading)[1]).get("number") != number:
            pass
    kept = 0
    while stalled.poll(200):
        kept += "number" in msgpack.unpackb(stalled.recv_multipart()[1])
    in_kernel = 2 * 212_992 // 700  # of both ends
    assert QUEUE <= kept < 2 * QUEUE + in_kernel


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_who_sends_too_large_a_frame_is_hung_up_on(tmp_path: Path, kind: int) -> None:
    with Sockets() as sockets:
        server = sockets.keep(open_socket(sockets.context, kind, send=10, receive=10, largest=1024))
        server.bind(f"ipc://{tmp_path}/x")
        events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
        client = sockets.open(zmq.XSUB if kind == zmq.XPUB else zmq.DEALER)
        client.connect(f"ipc://{tmp_path}/x")
        client.send(b"\x01" + b"x" * 1024)
        assert events.poll(10_000), "nobody was disconnected"
        assert not server.poll(0)


@pytest.mark.parametrize(
    ("attack", "copies", "estimates"),
    [
        ("subscribe_and_leave", 1, 100),
        pytest.param("subscribe_and_leave", 3, 600, marks=pytest.mark.check),
        pytest.param("endless_to_stream", 3, 600, marks=pytest.mark.check),
        pytest.param("unique_subscriptions", 3, 600, marks=pytest.mark.check),
    ],
)
def test_a_flood_costs_those_who_come_by_the_other_door_no_estimate(
    stand: Stand, attack: str, copies: int, estimates: int
) -> None:
    honest, flooded = (
        stand.listener(topics.ESTIMATE, endpoint=at) for at in (stand.stream, stand.other)
    )
    stand.received(flooded)
    first = seq(stand.received(honest))
    with contextlib.ExitStack() as flood:
        for _ in range(copies):
            flood.enter_context(attacked(attack, stand.other))
        heard = [seq(stand.received(honest)) for _ in range(estimates)]
    assert heard == list(range(first + 1, first + 1 + estimates))
    came = 0
    while seq(stand.received(flooded)) < heard[-1]:
        came += 1
    # `pytest -rP` shows it
    print(f"{copies} × {attack}: {1 - came / estimates:.0%} lost at that door")  # noqa: T201


MOST_BYTES = 160 << 20
ESTIMATES = 20  # that an honest subscriber hears meanwhile


@pytest.mark.parametrize(
    ("attack", "endpoint", "copies"),
    [("shut", "ipc://{}/stream", 1), ("requests", "ipc://{}/control", 2)],
)
def test_an_attack_costs_neither_the_door_nor_honest_peers_anything(
    tmp_path: Path, attack: str, endpoint: str, copies: int
) -> None:
    with Stand(tmp_path) as stand:
        door, honest = stand.pid, stand.listener(b"/taxeld/e")
        stand.received(honest)
        lost = stand.losses(honest)
        for _ in range(copies):
            stand.enter_context(attacked(attack, endpoint.format(tmp_path)))
        for _ in range(ESTIMATES):
            stand.received(honest)
        assert stand.answer({"cmd": "info"})["ok"]
        stand.received(stand.listener(b"/taxeld/e"))
        assert resident_bytes(door) < MOST_BYTES
        assert stand.pid == door
        assert not lost.poll(0)


ROBOT, CLIENTS = "tcp://192.0.2.1:8", "tcp://192.0.2.1:9"


def pair(directory: Path, name: str) -> tuple[bytes, bytes]:
    directory.mkdir(exist_ok=True)
    create_certificates(directory, name)
    secret = directory / f"{name}.key_secret"
    secret.chmod(0o640)
    public, private = load_certificate(secret)
    return public, private


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A daemon's directory, with one client and a robot; the client's own stands beside it."""
    directory, client_side = tmp_path / "keys", tmp_path / "client"
    pair(directory, "server")
    pair(client_side, "client")
    pair(tmp_path / "robot", "robot")
    (directory / "clients").mkdir()
    (directory / "clients" / "client.key").write_bytes((client_side / "client.key").read_bytes())
    (directory / "robot.key").write_bytes((tmp_path / "robot" / "robot.key").read_bytes())
    (client_side / "server.key").write_bytes((directory / "server.key").read_bytes())
    return directory


class Keyed(Stand):
    """A door that takes keys on TCP, and its clients."""

    def __init__(self, place: Path, **settings: Any) -> None:
        self.tcp, self.asked = robots_endpoint(ANYWHERE), robots_endpoint(ANYWHERE)
        taken = {"relay_publish": (self.tcp,), "relay_control": self.asked}
        super().__init__(place, keys=str(place / "keys"), **(taken | settings))
        self.server = curve.public_key(place / "keys" / "server.key")

    def holder(self, *own: bytes, server: bytes = b"", kind: int = zmq.SUB) -> zmq.Socket[Any]:
        """A socket on TCP with a pair of keys; without one it is plain."""
        made = self.socket(kind)
        if own:
            curve.as_client(made, server or self.server, *own)
        if kind == zmq.SUB:
            made.setsockopt(zmq.SUBSCRIBE, b"")
        made.connect(self.tcp if kind == zmq.SUB else self.asked)
        return made


@pytest.fixture
def keyed(keys: Path, tmp_path: Path) -> Iterator[Keyed]:
    assert keys.is_dir()
    with Keyed(tmp_path) as made:
        yield made


def test_only_the_holder_of_an_authorised_key_hears_or_asks_anything(
    keyed: Keyed, tmp_path: Path
) -> None:
    own = curve.secret_key(tmp_path / "client/client.key_secret")
    known = keyed.holder(*own)
    while keyed.received(known)[0] != topics.INFO:
        pass
    assert keyed.link.counts["keys_refused"] == 0
    stranger = keyed.holder(*pair(tmp_path / "stranger", "stranger"))
    plain = keyed.holder()
    misled = keyed.holder(*own, server=pair(tmp_path / "fake", "fake")[0])
    keyed.until(lambda: keyed.link.counts["keys_refused"])
    for _ in range(20):
        keyed.received(known)
    assert not any(socket.poll(0) for socket in (stranger, plain, misled))
    unheard, asking = keyed.holder(kind=zmq.REQ), keyed.holder(*own, kind=zmq.REQ)
    for each in (unheard, asking):
        each.send(b"\x81\xa3cmd\xa4info")
    keyed.received(asking)
    assert not unheard.poll(100)
    keyed.received(keyed.listener(b"/taxeld/e"))  # the socket file takes none


def test_a_client_takes_its_keys_from_the_environment(
    keyed: Keyed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(client.KEYS, str(tmp_path / "client"))
    assert keyed.asked_by_client("info", keyed.asked)["ok"]


def test_newcomers_with_a_key_are_served_beside_a_flood_of_those_without_and_after_it(
    keyed: Keyed, tmp_path: Path
) -> None:
    own = curve.secret_key(tmp_path / "client/client.key_secret")
    with attacked("strange_keys", keyed.tcp, keyed.server.decode()):
        keyed.until(lambda: keyed.link.counts["keys_refused"] > 300)
        for _ in range(3):
            keyed.received(keyed.holder(*own))
    keyed.received(keyed.holder(*own))
    assert resident_bytes(pid(keyed.relay)) < 100 << 20


def test_a_robots_poses_are_believed_only_from_the_holder_of_its_key(
    keys: Path, tmp_path: Path
) -> None:
    assert keys.is_dir()
    endpoint = robots_endpoint(ANYWHERE)
    with Keyed(tmp_path, robot=endpoint) as keyed:

        def robot(x: float, secret: bytes) -> zmq.Socket[Any]:
            made = keyed.socket(zmq.PUB)
            made.setsockopt(zmq.CURVE_SERVER, 1)
            made.setsockopt(zmq.CURVE_SECRETKEY, secret)
            keyed.until_bound(made, endpoint)
            made.send_multipart(pose(x))
            return made

        with robot(1.0, pair(tmp_path / "fake", "fake")[1]) as false:
            keyed.send_until(lambda: keyed.link.report.robot.refused, false, *pose(1.0))
        true = robot(2.0, curve.secret_key(tmp_path / "robot/robot.key_secret")[1])
        keyed.send_until(lambda: keyed.poses, true, *pose(2.0))
        assert {p[1] for p in keyed.poses} == {2.0}


@pytest.mark.parametrize(
    ("path", "made", "fault"),
    [
        ("server.key_secret", None, "server.key_secret cannot be read"),
        ("server.key_secret", "x", "is no certificate"),
        ("server.key_secret", 0o644, "is open to others; chmod 640"),
        ("robot.key", None, "robot.key cannot be read"),
        ("robot.key", "public-key", "robot.key is no certificate"),
        ("robot.key", f'public-key = "{"#" * 40}"', "robot.key is no certificate"),
        ("clients/client.key", None, "no clients/*.key in"),
        ("clients/b.key", 'public-key = "short"', "b.key is no certificate"),
    ],
)
def test_keys_that_cannot_be_used_are_one_line(
    keys: Path, path: str, made: str | int | None, fault: str
) -> None:
    """By its text, by its mode, or as it is missing."""
    if isinstance(made, int):
        (keys / path).chmod(made)
    else:
        (keys / path).unlink() if made is None else (keys / path).write_text(made, encoding="ascii")
    said = rf"^curve\.directory: .*{re.escape(fault)}"
    refuses(said, curve.read_keys, str(keys), ROBOT, [CLIENTS])


def test_the_documented_commands_make_a_pair_that_is_taken(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "stream.md").read_text(encoding="utf-8")
    commands = text.split("```sh\n", maxsplit=1)[1].split("```", maxsplit=1)[0]
    commands = commands.replace("python3", sys.executable).replace("/etc/taxeld", str(tmp_path))
    subprocess.run(commands, shell=True, check=True)
    public, secret = curve.secret_key(tmp_path / "keys" / "server.key_secret")
    assert public == curve.public_key(tmp_path / "keys" / "server.key")
    assert zmq.curve_public(secret) == public
    assert (tmp_path / "keys" / "clients").is_dir()
