"""Keys: who holds one gets everything, who does not gets nothing, and is counted."""

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq
from zmq.auth import create_certificates, load_certificate

from taxeld.errors import SetupError
from taxeld.stream import client, curve, topics

from ..rig.processes import attacked, resident_bytes
from .stand import ANYWHERE, Stand, pid, pose, robots_endpoint

ROBOT, CLIENTS = "tcp://192.0.2.1:8", "tcp://192.0.2.1:9"


def pair(directory: Path, name: str) -> tuple[bytes, bytes]:
    directory.mkdir(exist_ok=True)
    create_certificates(directory, name)
    secret = directory / f"{name}.key_secret"
    secret.chmod(0o640)
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
    with pytest.raises(SetupError, match=rf"^curve\.directory: .*{re.escape(fault)}") as error:
        curve.read_keys(str(keys), ROBOT, [CLIENTS])
    assert "\n" not in str(error.value)


def test_the_documented_commands_make_a_pair_that_is_taken(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "stream.md").read_text(encoding="utf-8")
    commands = text.split("```sh\n", maxsplit=1)[1].split("```", maxsplit=1)[0]
    commands = commands.replace("python3", sys.executable).replace("/etc/taxeld", str(tmp_path))
    subprocess.run(commands, shell=True, check=True)
    public, secret = curve.secret_key(tmp_path / "keys" / "server.key_secret")
    assert public == curve.public_key(tmp_path / "keys" / "server.key")
    assert zmq.curve_public(secret) == public
    assert (tmp_path / "keys" / "clients").is_dir()
