"""Binding beside the dead and the living, and frames without end."""

import os
import signal
import socket as unix
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from taxeld.errors import SetupError
from taxeld.sockets import Inbox, bind, open_socket, unpack

from .conftest import Sockets


def publisher(sockets: Sockets) -> zmq.Socket[Any]:
    return sockets.keep(open_socket(sockets.context, zmq.XPUB, send=10, receive=4, largest=1024))


def test_an_ipc_socket_is_open_to_owner_and_group_alone(sockets: Sockets, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        bind(publisher(sockets), f"ipc://{tmp_path}/stream", "publish.endpoints")
        assert os.umask(0) == 0, "the umask of the process is left as it was"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "stream").stat().st_mode) == 0o660


def test_the_socket_of_a_killed_daemon_is_taken_over(sockets: Sockets, tmp_path: Path) -> None:
    program = (
        "import sys, time, zmq\n"
        "s = zmq.Context().socket(zmq.XPUB)\ns.bind(sys.argv[1])\n"
        "print(flush=True)\ntime.sleep(60)\n"
    )
    endpoint = f"ipc://{tmp_path}/stream"
    with subprocess.Popen(
        [sys.executable, "-c", program, endpoint], stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        try:
            with pytest.raises(SetupError, match=r"publish\.endpoints: another daemon serves /"):
                bind(publisher(sockets), endpoint, "publish.endpoints")
        finally:
            other.kill()
    assert (tmp_path / "stream").is_socket()
    bind(publisher(sockets), endpoint, "publish.endpoints")
    with unix.socket(unix.AF_UNIX) as probe:
        probe.connect(str(tmp_path / "stream"))


def test_a_file_that_is_no_socket_is_left_alone(sockets: Sockets, tmp_path: Path) -> None:
    precious = tmp_path / "stream"
    precious.write_text("precious", encoding="ascii")
    with pytest.raises(SetupError, match="is no socket; remove it or name another endpoint"):
        bind(publisher(sockets), f"ipc://{precious}", "publish.endpoints")
    assert precious.read_text(encoding="ascii") == "precious"


def test_a_port_in_use_is_one_line(sockets: Sockets) -> None:
    with unix.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(SetupError) as error:
            bind(publisher(sockets), f"tcp://127.0.0.1:{port}", "publish.endpoints")
    line = str(error.value)
    assert line.startswith(f"publish.endpoints: cannot bind tcp://127.0.0.1:{port} (Address alr")
    assert "\n" not in line


def test_a_message_of_very_many_frames_takes_many_ticks(sockets: Sockets) -> None:
    inside, outside = sockets.open(zmq.PAIR), sockets.open(zmq.PAIR)
    inside.bind("inproc://many")
    outside.connect("inproc://many")
    outside.send_multipart([b"x"] * 1000)
    outside.send_multipart([b"a", b"b"])
    inbox = Inbox(inside, 3)
    heard, ticks = [], 0
    while len(heard) < 2:
        heard += inbox.take(50)
        ticks += 1
    assert heard == [[b"x"] * 4, [b"a", b"b"]], "the long one is cut, the next one whole"
    assert ticks == 21


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_who_sends_too_large_a_frame_is_hung_up_on(
    sockets: Sockets, tmp_path: Path, kind: int
) -> None:
    server = sockets.keep(open_socket(sockets.context, kind, send=10, receive=10, largest=1024))
    bind(server, f"ipc://{tmp_path}/x", "x")
    events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    client = sockets.open(zmq.XSUB if kind == zmq.XPUB else zmq.DEALER)
    client.connect(f"ipc://{tmp_path}/x")
    client.send(b"\x01" + b"x" * 1024)
    assert events.poll(10_000), "nobody was disconnected"
    assert not server.poll(0)


def test_a_peer_that_never_speaks_again_is_let_go(sockets: Sockets, tmp_path: Path) -> None:
    """A stopped process holds its connection open, and answers no heartbeat."""
    server = publisher(sockets)
    server.setsockopt(zmq.HEARTBEAT_IVL, 50)
    server.setsockopt(zmq.HEARTBEAT_TIMEOUT, 200)
    endpoint = f"ipc://{tmp_path}/stream"
    bind(server, endpoint, "x")
    events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    program = (
        "import sys, time, zmq\ns = zmq.Context().socket(zmq.SUB)\n"
        "s.connect(sys.argv[1])\ns.subscribe(b'')\ntime.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program, endpoint]) as peer:
        try:
            assert server.poll(10_000), "nobody subscribed"
            assert not events.poll(500), "who answers is kept"
            peer.send_signal(signal.SIGSTOP)
            assert events.poll(10_000), "who does not is not"
        finally:
            peer.kill()


@given(st.binary(max_size=64))
def test_arbitrary_bytes_are_a_map_or_an_empty_one(body: bytes) -> None:
    assert isinstance(unpack(body), dict)


@pytest.mark.parametrize(
    "body",
    [b"\x91" * 4000, b"\x81\xa1x" * 1000, b"\xdf\xff\xff\xff\xff", b"\xc7\x0c\xff" + b"\xff" * 12,
     msgpack.packb({"a": 1}) + b"\x00", msgpack.packb({1: 2})],
)  # fmt: skip
def test_bombs_are_an_empty_map(body: bytes) -> None:
    assert unpack(body) == {}
