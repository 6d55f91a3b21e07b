"""Asking a running daemon over its control endpoint."""

import os
import time
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream import curve
from taxeld.stream.sockets import connect, open_socket, unpack

ANSWER_BYTES = 1 << 24  # the most scans of 5000 taxels have 8 MB
TIMEOUT_S = 2.0
AGAIN_S = 0.5  # without an answer for so long, the daemon may have closed its socket: ask anew
KEYS = "TAXELD_KEYS"  # in the environment: a directory of SERVER and OWN, for a daemon beyond here
SERVER, OWN = "server.key", "client.key_secret"


def ask(
    endpoint: str,
    command: str,
    timeout_s: float | None = None,
    **what: object,
) -> dict[str, Any] | None:
    """The answer, or None where none comes; `what` are further keys of the request.

    Raises:
        SetupError: the endpoint is none, or a key cannot be used.
    """
    deadline_s = time.monotonic() + (TIMEOUT_S if timeout_s is None else timeout_s)
    with zmq.Context() as context:
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            with client_socket(context, zmq.REQ, endpoint) as socket:
                socket.send(msgpack.packb({"cmd": command} | what))
                if socket.poll(round(min(left_s, AGAIN_S) * 1000)):
                    return unpack(socket.recv())
    return None


def client_socket(
    context: zmq.Context[Any], kind: int, endpoint: str, *, send: int = 1, receive: int = 1
) -> zmq.Socket[Any]:
    """A socket that is connected to a daemon and keeps `send` and `receive` messages.

    Raises:
        SetupError: the endpoint is none, or a key cannot be used.
    """
    keys = os.environ.get(KEYS)
    fault = endpoints.fault(endpoint, bool(keys))
    if fault:
        raise SetupError(f"endpoint: {fault.replace('set curve.directory', f'set {KEYS}')}")
    socket = open_socket(context, kind, send=send, receive=receive, largest=ANSWER_BYTES)
    try:
        if keys and endpoint.startswith(endpoints.TCP):
            own = curve.secret_key(Path(keys, OWN), KEYS)
            curve.as_client(socket, curve.public_key(Path(keys, SERVER), KEYS), *own)
        connect(socket, endpoint, "endpoint")
    except SetupError:
        socket.close()
        raise
    return socket
