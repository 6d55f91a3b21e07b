"""Peers whose messages never end: they are disconnected, and nobody else."""

import os
import socket as kernel
import struct
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq

from taxeld.stream.door import Door
from taxeld.stream.hoard import (
    GROWTH_BYTES,
    LOOK_S,
    OWN_S,
    Hoard,
    _allocated,
    _give_back,
)
from taxeld.stream.sockets import open_socket

from .conftest import Sockets

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(16) + bytes(32)
READY = b"\x05READY\x0bSocket-Type" + struct.pack(">I", 3)
MORE = (b"\x01\xf0" + b"x" * 240) * 500  # frames of 240 bytes, of which none is the last
MOST_SENT = 8 * GROWTH_BYTES
COMES = 8


def served(sockets: Sockets, place: Path, kind: int) -> tuple[zmq.Socket[Any], str]:
    _give_back()  # what other tests have left free would take in much before the process grows
    socket = sockets.keep(open_socket(sockets.context, kind, send=10, receive=2, largest=1024))
    endpoint = f"ipc://{place}/x"
    door = Door(endpoint, "x")
    sockets.callback(door.close)
    door.let_in(socket)
    return socket, endpoint


def hello(endpoint: str, kind: bytes = b"SUB") -> kernel.socket:
    """A connection that speaks ZMTP by hand."""
    peer = kernel.socket(kernel.AF_UNIX)
    peer.connect(endpoint.removeprefix("ipc://"))
    peer.settimeout(10.0)
    peer.sendall(GREETING)
    while len(peer.recv(64, kernel.MSG_PEEK)) < 64:
        pass
    peer.sendall(b"\x04" + bytes([len(READY + kind)]) + READY + kind)
    return peer


def pour(peer: kernel.socket, server: zmq.Socket[Any], hoard: Hoard, now_s: float = 0.0) -> int:
    """Send until it is disconnected; → how many bytes that took."""
    sent = 0
    try:
        while sent < MOST_SENT:
            sent += peer.send(MORE)
            assert not server.poll(0), "there is no whole message"
            now_s += LOOK_S
            hoard.look(now_s)
    except OSError:
        return sent
    raise AssertionError(f"{sent} bytes were taken")


@pytest.mark.parametrize("kind", [zmq.XPUB, zmq.ROUTER])
def test_whose_message_never_ends_is_disconnected_and_nobody_else(
    sockets: Sockets, tmp_path: Path, kind: int
) -> None:
    server, endpoint = served(sockets, tmp_path, kind)
    hoard = Hoard([endpoint])
    sockets.callback(hoard.close)
    quiet: zmq.Socket[Any] = sockets.open(zmq.SUB if kind == zmq.XPUB else zmq.DEALER)
    lost = sockets.keep(quiet.get_monitor_socket(zmq.EVENT_DISCONNECTED))
    quiet.connect(endpoint)
    time.sleep(0.1)
    hoard.look(-1.0)
    with hello(endpoint, b"SUB" if kind == zmq.XPUB else b"REQ") as peer:
        assert pour(peer, server, hoard) > GROWTH_BYTES / 4
    assert hoard.hung_up == 1
    assert not lost.poll(100)


def test_who_comes_again_each_time_gathers_no_more_than_who_comes_once(
    sockets: Sockets, tmp_path: Path
) -> None:
    server, endpoint = served(sockets, tmp_path, zmq.XPUB)
    hoard = Hoard([endpoint])
    sockets.callback(hoard.close)
    hoard.look(-1.0)
    before = _allocated()
    for again in range(COMES):
        with hello(endpoint) as peer:
            pour(peer, server, hoard, now_s=10.0 * again)
        deadline = time.monotonic() + 30.0
        while _allocated() > before + GROWTH_BYTES / 2:  # ZeroMQ lets go of it by itself
            assert time.monotonic() < deadline
            assert not server.poll(1)
    assert hoard.hung_up == COMES


def test_memory_that_nobody_sends_is_the_processs_own(sockets: Sockets, tmp_path: Path) -> None:
    server, endpoint = served(sockets, tmp_path, zmq.XPUB)
    hoard = Hoard([endpoint])
    sockets.callback(hoard.close)
    hoard.look(0.0)
    greeted = sockets.keep(server.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED))
    with hello(endpoint) as peer:
        assert greeted.poll(10_000), "until then it is sending"
        time.sleep(0.3)  # the server's thread reads to the end after that event
        own = np.ones(2 * GROWTH_BYTES, np.uint8)
        hoard.look(1.0)
        hoard.look(1.0 + OWN_S)
        peer.send(b"\x00")  # a frame that has begun
        hoard.look(2.0 + OWN_S)
    assert hoard.hung_up == 0
    assert own.all()


def test_looking_takes_no_descriptors(sockets: Sockets, tmp_path: Path) -> None:
    _, endpoint = served(sockets, tmp_path, zmq.XPUB)
    hoard = Hoard([endpoint])
    sockets.callback(hoard.close)
    hoard.look(0.0)
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208
    hoard._resident, hoard._least = 0.0, -2.0 * GROWTH_BYTES
    hoard.look(1.0)
    assert hoard.hung_up == 0
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
