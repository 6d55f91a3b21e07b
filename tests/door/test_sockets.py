"""What a peer sends is bounded in size, and whatever it holds is a map or none."""

from pathlib import Path

import msgpack
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from taxeld.door.binding import Binding
from taxeld.stream.sockets import open_socket, unpack

from ..rig.sockets import Sockets


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_who_sends_too_large_a_frame_is_hung_up_on(tmp_path: Path, kind: int) -> None:
    endpoint = f"ipc://{tmp_path}/x"
    with Sockets() as sockets:
        server = sockets.keep(open_socket(sockets.context, kind, send=10, receive=10, largest=1024))
        binding = Binding(endpoint, "x")
        sockets.callback(binding.close)
        binding.let_in(server)
        events = sockets.keep(server.get_monitor_socket(zmq.EVENT_DISCONNECTED))
        client = sockets.open(zmq.XSUB if kind == zmq.XPUB else zmq.DEALER)
        client.connect(endpoint)
        client.send(b"\x01" + b"x" * 1024)
        assert events.poll(10_000), "nobody was disconnected"
        assert not server.poll(0)


@given(st.binary(max_size=64))
def test_arbitrary_bytes_are_a_map_or_an_empty_one(body: bytes) -> None:
    assert isinstance(unpack(body), dict)


@pytest.mark.parametrize(
    "body",
    [
        b"\x91" * 4000,
        b"\x81\xa1x" * 1000,
        b"\xdf\xff\xff\xff\xff",
        b"\xc7\x0c\xff" + b"\xff" * 12,
        msgpack.packb({"a": 1}) + b"\x00",
        msgpack.packb({1: 2}),
    ],
)
def test_bombs_are_an_empty_map(body: bytes) -> None:
    assert unpack(body) == {}
