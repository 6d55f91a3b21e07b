"""ZeroMQ: the published streams, the robot's sensor poses, and the control socket.

Nothing here ever blocks the loop: sends that find no room are dropped and counted, receives take
what is there up to a bound.
"""

import contextlib
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld import messages
from taxeld.errors import SetupError
from taxeld.poses import PoseTrack

POSES_PER_TICK = 200
REQUESTS_PER_TICK = 4
MAX_REQUEST_BYTES = 4096

Handler = Callable[[dict[str, Any]], dict[str, Any]]


class Publisher:
    """XPUB on all endpoints: [topic, msgpack map, b"%.6f" of the measurement's Unix time]."""

    def __init__(self, context: zmq.Context[Any], queue: int, info: dict[str, Any]) -> None:
        """`queue`: messages kept for a subscriber that is slow; `info`: for a new one."""
        self.dropped = 0
        self._info = info
        self._socket = context.socket(zmq.XPUB)
        self._socket.setsockopt(zmq.SNDHWM, queue)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.XPUB_VERBOSE, 1)  # a late joiner of a known topic is heard too

    def bind(self, endpoints: tuple[str, ...]) -> None:
        """Raises SetupError where an endpoint cannot be had."""
        for endpoint in endpoints:
            _bind(self._socket, endpoint, "publish.endpoints")

    def send(self, topic: bytes, message: dict[str, Any], t: float) -> None:
        try:
            self._socket.send_multipart(
                (topic, msgpack.packb(message), b"%.6f" % t), flags=zmq.NOBLOCK
            )
        except zmq.Again:
            self.dropped += 1

    def greet(self, t: float) -> None:
        """Tell new subscribers who speaks."""
        with contextlib.suppress(zmq.Again):
            while True:
                event = self._socket.recv(zmq.NOBLOCK)
                if event[:1] == b"\x01" and messages.INFO.startswith(event[1:]):
                    self.send(messages.INFO, self._info, t)

    def close(self) -> None:
        self._socket.close()


class PoseInput:
    """SUB to the robot: `/robot/sensor_pose`, a map {t, x, y, theta}."""

    def __init__(self, context: zmq.Context[Any], track: PoseTrack) -> None:
        self.malformed = 0
        self._track = track
        self._socket = context.socket(zmq.SUB)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.RCVHWM, 2 * POSES_PER_TICK)
        self._socket.setsockopt(zmq.SUBSCRIBE, messages.SENSOR_POSE)

    def connect(self, endpoint: str) -> None:
        """Raises SetupError where the endpoint is none."""
        try:
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            raise SetupError(f"sensor_pose.endpoint: cannot use {endpoint} ({error})") from None

    def poll(self) -> None:
        """Take the poses that have arrived."""
        for _ in range(POSES_PER_TICK):
            try:
                parts = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            pose = _pose(parts)
            if pose is None:
                self.malformed += 1
            else:
                self._track.add(*pose)

    def close(self) -> None:
        self._socket.close()


class Control:
    """REP: msgpack {"cmd": …} → {"ok": bool, …}."""

    def __init__(self, context: zmq.Context[Any], handlers: Mapping[str, Handler]) -> None:
        self._handlers = handlers
        # ROUTER in place of REP: a client that breaks off in mid-request cannot wedge it
        self._socket = context.socket(zmq.ROUTER)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_REQUEST_BYTES)

    def bind(self, endpoint: str) -> None:
        """Raises SetupError where the endpoint cannot be had."""
        _bind(self._socket, endpoint, "control.endpoint")

    def poll(self) -> None:
        """Answer what has been asked, a few requests a tick."""
        for _ in range(REQUESTS_PER_TICK):
            try:
                *route, body = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            with contextlib.suppress(zmq.Again):
                answer = msgpack.packb(self._answer(body))
                self._socket.send_multipart([*route, answer], flags=zmq.NOBLOCK)

    def close(self) -> None:
        self._socket.close()

    def _answer(self, body: bytes) -> dict[str, Any]:
        request = _unpack(body)
        command = request.get("cmd")
        handler = self._handlers.get(command) if isinstance(command, str) else None
        if handler is None:
            known = ", ".join(self._handlers)
            return {"ok": False, "error": f"unknown cmd {command!r}; known: {known}"}
        return {"ok": True, **handler(request)}


def request(endpoint: str, command: str, timeout_s: float = 2.0) -> dict[str, Any]:
    """Ask a running daemon.

    Raises:
        SetupError: none answers at `endpoint`.
    """
    with zmq.Context() as context, context.socket(zmq.REQ) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.connect(endpoint)
        socket.send(msgpack.packb({"cmd": command}))
        if not socket.poll(int(timeout_s * 1000)):
            raise SetupError(f"no daemon answers at {endpoint}; is 'taxeld run' there?")
        return _unpack(socket.recv())


def _bind(socket: zmq.Socket[Any], endpoint: str, key: str) -> None:
    """Bind, with ipc sockets readable by owner and group.

    Raises:
        SetupError: the endpoint is taken or its directory missing.
    """
    path = Path(endpoint.removeprefix("ipc://")) if endpoint.startswith("ipc://") else None
    if path and not path.parent.is_dir():
        raise SetupError(f"{key}: {path.parent} does not exist; create it or name another endpoint")
    try:
        socket.bind(endpoint)
    except zmq.ZMQError as error:
        raise SetupError(f"{key}: cannot bind {endpoint} ({error})") from None
    if path and path.exists():
        os.chmod(path, 0o660)  # noqa: PTH101


def _pose(parts: list[bytes]) -> tuple[float, float, float, float] | None:
    if len(parts) != 3:
        return None
    values = [_unpack(parts[1]).get(key) for key in ("t", "x", "y", "theta")]
    if not all(isinstance(v, (int, float)) and math.isfinite(v) for v in values):
        return None
    t, x, y, theta = (float(v) for v in values if v is not None)
    return t, x, y, theta


def _unpack(body: bytes) -> dict[str, Any]:
    """A msgpack map, or an empty one for anything else."""
    try:
        value = msgpack.unpackb(body)
    except (ValueError, msgpack.UnpackException):
        return {}
    return value if isinstance(value, dict) else {}
