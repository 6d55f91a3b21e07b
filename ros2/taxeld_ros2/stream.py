"""The daemon's streams and the robot's poses over ZeroMQ, as the bridge uses them."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld.stream import client, curve, messages
from taxeld.stream.sockets import connect, open_socket, unpack, why

TOPICS = (messages.ESTIMATE, messages.HEALTH, messages.INFO)
QUEUE = 1000
SUBSCRIPTIONS = 64  # that may wait for the daemon: beyond it ZeroMQ drops them
MESSAGE_BYTES = 1 << 24
MOST = 100  # messages taken at once


class VersionError(SetupError):
    """What comes is another version of the stream, or none at all."""


class Stream:
    """What a daemon or its relay publishes."""

    def __init__(
        self, context: "zmq.Context[Any]", endpoint: str, keys: Path | None, particles: bool
    ) -> None:
        """Raises SetupError: the endpoint is none, or a key cannot be used."""
        self.endpoint = endpoint
        fault = endpoints.fault(endpoint, keys is not None)
        if fault:
            raise SetupError(f"--stream: {fault.replace('set curve.directory', 'name --keys')}")
        self.socket = open_socket(
            context, zmq.SUB, send=SUBSCRIPTIONS, receive=QUEUE, largest=MESSAGE_BYTES
        )
        if keys is not None and endpoint.startswith(endpoints.TCP):
            own = curve.secret_key(keys / client.OWN, "--keys")
            curve.as_client(self.socket, curve.public_key(keys / client.SERVER, "--keys"), *own)
        for topic in (*TOPICS, *([messages.PARTICLES] if particles else [])):
            self.socket.setsockopt(zmq.SUBSCRIBE, topic)
        connect(self.socket, endpoint, "--stream")

    def take(self) -> Iterator[tuple[bytes, dict[str, Any]]]:
        """What has come, topic and map.

        Raises:
            VersionError: it is of another version.
        """
        for _ in range(MOST):
            try:
                topic, body, *_ = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            except ValueError:  # one frame
                continue
            message = unpack(body)
            version = message.get("v")
            if not isinstance(version, int):
                raise VersionError(f"{self.endpoint}: what is published there is no taxeld's")
            if version != messages.VERSION:
                raise VersionError(
                    f"{self.endpoint}: speaks version {version} of the stream, and this bridge "
                    f"version {messages.VERSION}; install taxeld of one release on both sides"
                )
            yield topic, message

    def close(self) -> None:
        self.socket.close()


class PoseOutput:
    """`/robot/sensor_pose`, where the daemon is told to expect it."""

    def __init__(self, context: "zmq.Context[Any]", endpoint: str) -> None:
        """Raises SetupError: it cannot be had."""
        self.sent = 0
        self.last = 0.0  # Unix seconds
        if not endpoints.is_local(endpoint):
            raise SetupError(
                f"sensor_pose.endpoint: '{endpoint}' is not of this machine; run the bridge beside "
                "the daemon, with an endpoint as tcp://127.0.0.1:9874"
            )
        self._socket = open_socket(
            context, zmq.PUB, send=QUEUE, receive=SUBSCRIPTIONS, largest=1024
        )
        try:
            self._socket.bind(endpoint)
        except zmq.ZMQError as error:
            raise SetupError(
                f"sensor_pose.endpoint: cannot publish at {endpoint} ({why(error)}); does "
                "something else publish the robot's pose there?"
            ) from None

    def send(self, t: float, x: float, y: float, theta: float) -> None:
        body = msgpack.packb({"t": t, "x": x, "y": y, "theta": theta})
        self._socket.send_multipart((messages.SENSOR_POSE, body, b"%.6f" % t), zmq.NOBLOCK)
        self.sent += 1
        self.last = time.time()

    def close(self) -> None:
        self._socket.close()
