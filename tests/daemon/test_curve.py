"""Keys: who holds one gets everything, who does not gets nothing, and is counted."""

import socket as unix
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from zmq.auth import create_certificates, load_certificate

from taxeld.commands.record import Recording
from taxeld.commands.relay import Relay
from taxeld.config.file import parse
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.service.loop import Daemon
from taxeld.stream import client, curve, messages

from .conftest import Sockets

LOADS = (curve.relay_keys, curve.robot_keys)


def pair(directory: Path, name: str) -> tuple[bytes, bytes]:
    directory.mkdir(exist_ok=True)
    create_certificates(directory, name)
    secret = directory / f"{name}.key_secret"
    secret.chmod(0o600)
    public, private = load_certificate(secret)
    assert private is not None
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


def free_port() -> int:
    with unix.create_server(("127.0.0.1", 0)) as probe:
        port: int = probe.getsockname()[1]
        return port


def configuration(place: Path, stream: int, control: int = 0, poses: int = 0) -> Config:
    text = (
        f'[source]\nkind = "can"\ninterface = "virtual"\nchannel = "{place.name}"\n'
        f'[scene]\nbundle = "box"\n[curve]\ndirectory = "{place}/keys"\nloopback = true\n'
        f'[publish]\nendpoints = ["ipc://{place}/stream"]\n'
        f'[control]\nendpoint = "ipc://{place}/control"\n'
        f'[relay]\npublish = ["tcp://127.0.0.1:{stream}"]\n'
        f'control = "{f"tcp://127.0.0.1:{control}" if control else ""}"\n'
        f'[sensor_pose]\nendpoint = "{f"tcp://127.0.0.1:{poses}" if poses else ""}"\n'
    )
    return parse(text)


def subscriber(
    sockets: Sockets, endpoint: str, server: bytes = b"", own: tuple[bytes, bytes] = (b"", b"")
) -> zmq.Socket[Any]:
    socket = sockets.open(zmq.SUB)
    if server:
        curve.as_client(socket, server, *own)
    socket.setsockopt(zmq.SUBSCRIBE, b"")
    socket.connect(endpoint)
    return socket


class Both:
    """A daemon and its relay, in turns."""

    def __init__(self, sockets: Sockets, config: Config) -> None:
        self.daemon = Daemon(config)
        sockets.callback(self.daemon.close)
        self.relay = Relay(config)
        sockets.callback(self.relay.close)

    def tick(self) -> None:
        self.daemon.tick(time.monotonic())
        self.relay.step()


def hears(both: Both, socket: zmq.Socket[Any], seconds: float = 10.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        both.tick()
        if socket.poll(2):
            return True
    return False


def test_only_the_holder_of_an_authorised_key_hears_anything(
    sockets: Sockets, keys: Path, tmp_path: Path
) -> None:
    port = free_port()
    endpoint = f"tcp://127.0.0.1:{port}"
    server = curve.public_key(keys / "server.key")
    both = Both(sockets, configuration(tmp_path, port))
    guard = both.relay._guard
    known = subscriber(
        sockets, endpoint, server, curve.secret_key(tmp_path / "client/client.key_secret")
    )
    assert hears(both, known)
    while known.recv_multipart()[0] != messages.INFO:
        assert hears(both, known), "nobody is greeted"
    assert guard.refused == 0
    stranger = subscriber(sockets, endpoint, server, pair(tmp_path / "stranger", "stranger"))
    plain = subscriber(sockets, endpoint)
    misled = subscriber(
        sockets, endpoint, pair(tmp_path / "fake", "fake")[0], pair(tmp_path / "fake", "own")
    )
    assert not hears(both, stranger, 1.0)
    assert not plain.poll(0)
    assert not misled.poll(0)
    assert guard.refused > 0
    deadline = time.monotonic() + 20.0
    while (parts := known.recv_multipart())[0] != messages.HEALTH or not told(parts[1]):
        assert time.monotonic() < deadline, "what the relay passes on does not say so"
        assert hears(both, known)
    assert hears(both, subscriber(sockets, f"ipc://{tmp_path}/stream")), "ipc stays plain"
    assert hears(both, known)


def told(health: bytes) -> int:
    refused: int = msgpack.unpackb(health)["keys_refused"]
    return refused


def ask(both: Both, *args: Any, **more: Any) -> dict[str, Any] | None:
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(client.ask, *args, **more)
        while not answer.done():
            both.tick()
        return answer.result()


@pytest.mark.usefixtures("keys")
def test_questions_take_keys_too(sockets: Sockets, tmp_path: Path) -> None:
    port = free_port()
    endpoint = f"tcp://127.0.0.1:{port}"
    both = Both(sockets, configuration(tmp_path, free_port(), control=port))
    for _ in range(20):
        both.tick()
    answer = ask(both, endpoint, "info", tmp_path / "client", timeout_s=10.0)
    assert answer is not None
    assert answer["ok"]
    assert ask(both, endpoint, "info", timeout_s=0.5) is None


@pytest.mark.usefixtures("keys")
def test_a_robots_poses_are_believed_only_from_the_holder_of_its_key(
    sockets: Sockets, tmp_path: Path
) -> None:
    port = free_port()
    daemon = Daemon(configuration(tmp_path, free_port(), poses=port))
    sockets.callback(daemon.close)

    def latest(own: tuple[bytes, bytes], seconds: float) -> float:
        with zmq.Context() as context, context.socket(zmq.PUB) as robot:
            robot.setsockopt(zmq.LINGER, 0)
            robot.setsockopt(zmq.CURVE_SERVER, 1)
            robot.setsockopt(zmq.CURVE_SECRETKEY, own[1])
            robot.bind(f"tcp://127.0.0.1:{port}")
            deadline = time.monotonic() + seconds
            body = msgpack.packb({"t": 1.0, "x": 0.0, "y": 0.0, "theta": 0.0})
            while time.monotonic() < deadline and daemon.pipeline.poses.latest_t != 1.0:
                robot.send_multipart([messages.SENSOR_POSE, body, b"1.0"])
                daemon.tick(time.monotonic())
                time.sleep(0.005)
        return daemon.pipeline.poses.latest_t

    assert latest(pair(tmp_path / "fake", "fake"), 1.0) == -float("inf")
    assert latest(curve.secret_key(tmp_path / "robot/robot.key_secret"), 10.0) == 1.0


@pytest.mark.usefixtures("keys")
def test_a_recording_hears_such_a_robot_and_ends(tmp_path: Path) -> None:
    config = configuration(tmp_path, free_port(), poses=free_port())
    (tmp_path / "config.toml").touch()
    recording = Recording(config, tmp_path / "config.toml", tmp_path / "session")
    recording.stopping = True
    assert "0 scans, 0 sensor poses" in recording.run()


@pytest.mark.parametrize(
    ("damage", "fault"),
    [
        (lambda keys: (keys / "server.key_secret").unlink(), "server.key_secret is not there"),
        (lambda keys: (keys / "server.key_secret").chmod(0o644), "is open to others; chmod 640"),
        (lambda keys: (keys / "server.key_secret").write_text("x"), "is no certificate"),
        (lambda keys: (keys / "robot.key").unlink(), "robot.key is not there"),
        (lambda keys: (keys / "clients" / "client.key").unlink(), "no clients/*.key in"),
        (
            lambda keys: (keys / "clients" / "b.key").write_text('public-key = "short"'),
            "b.key is no certificate",
        ),
        (lambda keys: (keys / "robot.key").write_text("public-key"), "robot.key is no certificate"),
        (
            lambda keys: (keys / "robot.key").write_text(f'public-key = "{"#" * 40}"'),
            "robot.key is no certificate",
        ),
    ],
)
def test_keys_that_cannot_be_used_are_one_line(
    keys: Path, tmp_path: Path, damage: Callable[[Path], object], fault: str
) -> None:
    damage(keys)
    with pytest.raises(SetupError) as error:
        _ = [load(configuration(tmp_path, 9, poses=8)) for load in LOADS]
    assert str(error.value).startswith("curve.directory: ")
    assert fault in str(error.value)
    assert "\n" not in str(error.value)


def test_a_secret_that_the_group_may_read_is_fine(keys: Path, tmp_path: Path) -> None:
    (keys / "server.key_secret").chmod(0o640)
    loaded = curve.relay_keys(configuration(tmp_path, 9))
    assert loaded is not None
    assert len(loaded.clients) == 1


def test_the_documented_commands_make_a_pair_that_is_taken(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "stream.md").read_text(encoding="utf-8")
    commands = text.split("```sh\n", maxsplit=1)[1].split("```", maxsplit=1)[0]
    commands = commands.replace("python3", sys.executable).replace("/etc/taxeld", str(tmp_path))
    subprocess.run(commands, shell=True, check=True)
    public, secret = curve.secret_key(tmp_path / "keys" / "server.key_secret")
    assert public == curve.public_key(tmp_path / "keys" / "server.key")
    assert zmq.curve_public(secret) == public
    assert (tmp_path / "keys" / "clients").is_dir()
