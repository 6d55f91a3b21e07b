"""Very many connections to a Unix socket, by hand: of another process, or of this one."""

import contextlib
import socket as kernel
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

CROWD = """
import socket, sys
peers = []
for _ in range(int(sys.argv[2])):
    peers.append(socket.socket(socket.AF_UNIX))
    peers[-1].connect(sys.argv[1])
    peers[-1].sendall(bytes.fromhex(sys.argv[3]))
print("there", flush=True)
sys.stdin.read()
"""
PIPES: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}


@contextlib.contextmanager
def crowd(path: Path, count: int, said: bytes = b"") -> Iterator[None]:
    """Another process that has so many connections, or tries to."""
    command = [sys.executable, "-c", CROWD, str(path), str(count), said.hex()]
    with subprocess.Popen(command, **PIPES) as other:
        assert other.stdout is not None
        other.stdout.readline()
        yield
        other.communicate()


@contextlib.contextmanager
def greeted(
    path: Path, kind: bytes, count: int, step: Callable[[], None]
) -> Iterator[list[kernel.socket]]:
    """So many sockets of a kind of ZeroMQ's, after both sides have said who they are; nothing waits
    on them. `step` is called until then."""
    ready = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    hello = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48) + bytes((4, len(ready))) + ready
    with contextlib.ExitStack() as opened:
        peers = [opened.enter_context(kernel.socket(kernel.AF_UNIX)) for _ in range(count)]
        for peer in peers:
            peer.connect(str(path))
            peer.sendall(hello)
            peer.setblocking(False)
        deadline = time.monotonic() + 20.0
        for peer in peers:
            heard = b""
            while b"Socket-Type" not in heard:
                assert time.monotonic() < deadline, "nobody answers"
                step()
                with contextlib.suppress(BlockingIOError):
                    heard += peer.recv(4096)
        yield peers
