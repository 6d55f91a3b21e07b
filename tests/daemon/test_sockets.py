"""Binding beside the dead and the living, and frames without end."""

import os
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

from taxeld.door.binding import Binding
from taxeld.errors import SetupError
from taxeld.stream.sockets import FRAMES_MAX, frames, hang_up, open_socket, unpack

from .conftest import Sockets


def publisher(sockets: Sockets) -> zmq.Socket[Any]:
    return sockets.keep(open_socket(sockets.context, zmq.XPUB, send=10, receive=4, largest=1024))


def bind(sockets: Sockets, socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
    binding = Binding(endpoint, key)
    sockets.callback(binding.close)
    binding.let_in(socket)


def test_an_ipc_socket_is_open_to_owner_and_group_alone(sockets: Sockets, tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        bind(sockets, publisher(sockets), f"ipc://{tmp_path}/stream", "publish.endpoints")
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
                bind(sockets, publisher(sockets), endpoint, "publish.endpoints")
        finally:
            other.kill()
    assert (tmp_path / "stream").is_socket()
    bind(sockets, publisher(sockets), endpoint, "publish.endpoints")
    with unix.socket(unix.AF_UNIX) as probe:
        probe.connect(str(tmp_path / "stream"))


def test_a_file_that_is_no_socket_is_left_alone(sockets: Sockets, tmp_path: Path) -> None:
    precious = tmp_path / "stream"
    precious.write_text("precious", encoding="ascii")
    with pytest.raises(SetupError, match="is no socket; remove it or name another endpoint"):
        bind(sockets, publisher(sockets), f"ipc://{precious}", "publish.endpoints")
    assert precious.read_text(encoding="ascii") == "precious"


def test_a_port_in_use_is_one_line(sockets: Sockets) -> None:
    with unix.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(SetupError) as error:
            bind(sockets, publisher(sockets), f"tcp://127.0.0.1:{port}", "publish.endpoints")
    line = str(error.value)
    assert line.startswith(f"publish.endpoints: cannot bind tcp://127.0.0.1:{port} (Address alr")
    assert "\n" not in line


def test_a_message_of_very_many_frames_is_not_read_to_its_end(sockets: Sockets) -> None:
    inside, outside = sockets.open(zmq.PAIR), sockets.open(zmq.PAIR)
    inside.bind("inproc://many")
    outside.connect("inproc://many")
    most = [b"a"] * FRAMES_MAX
    for parts in (most, [b"a", b"b"], [b"x"] * 1000, [b"c"]):
        outside.send_multipart(parts)
    assert [frame.bytes for frame in frames(inside) or []] == most
    assert [frame.bytes for frame in frames(inside) or []] == [b"a", b"b"]
    assert frames(inside) is None


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_who_sends_too_large_a_frame_is_hung_up_on(
    sockets: Sockets, tmp_path: Path, kind: int
) -> None:
    server = sockets.keep(open_socket(sockets.context, kind, send=10, receive=10, largest=1024))
    bind(sockets, server, f"ipc://{tmp_path}/x", "x")
    events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    client = sockets.open(zmq.XSUB if kind == zmq.XPUB else zmq.DEALER)
    client.connect(f"ipc://{tmp_path}/x")
    client.send(b"\x01" + b"x" * 1024)
    assert events.poll(10_000), "nobody was disconnected"
    assert not server.poll(0)


def test_hanging_up_disconnects_the_sender_alone(sockets: Sockets, tmp_path: Path) -> None:
    server = sockets.keep(
        open_socket(sockets.context, zmq.ROUTER, send=10, receive=10, largest=1024)
    )
    bind(sockets, server, f"ipc://{tmp_path}/x", "x")
    loud, quiet = sockets.open(zmq.DEALER), sockets.open(zmq.DEALER)
    lost = [s.get_monitor_socket(zmq.EVENT_DISCONNECTED) for s in (loud, quiet)]
    for monitor in lost:
        sockets.keep(monitor)
    for client in (loud, quiet):
        client.connect(f"ipc://{tmp_path}/x")
        client.send(b"hello")
    for _ in range(2):
        server.recv_multipart()
    loud.send(b"again")
    server.recv()
    frame = server.recv(copy=False)
    assert frame.bytes == b"again"
    assert hang_up(frame)
    assert lost[0].poll(10_000)
    assert not lost[1].poll(100)


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
