"""The bridge as a process, the daemon and the robot that it joins, DDS on this machine alone."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import zmq

from taxeld.stream import topics
from tests.rig.clocks import PATIENCE_S
from tests.rig.stream_page import documented

DOMAIN = 100 + os.getpid() % 100  # other runs of the tests have other domains
# Without multicast participants find each other at a domain's first ports. The lease is long, so
# that a participant that hangs is not taken for gone
URI = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/>"
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers><SPDPInterval>300ms</SPDPInterval>"
    "<LeaseDuration>600s</LeaseDuration></Discovery>"
    "</Domain></CycloneDDS>"
)
ENVIRONMENT = {**os.environ, "CYCLONEDDS_URI": URI, "ROS_DOMAIN_ID": str(DOMAIN)}


class End:
    """A socket of ZeroMQ at an endpoint, to be closed."""

    def __init__(self, kind: int, endpoint: str) -> None:
        self.endpoint = endpoint
        self._context: zmq.Context[Any] = zmq.Context()
        self._socket = self._context.socket(kind)
        self._socket.setsockopt(zmq.LINGER, 0)

    def close(self) -> None:
        self._socket.close()
        self._context.term()


class Daemon(End):
    """Publishes the examples of docs/stream.md."""

    def __init__(self, place: Path) -> None:
        super().__init__(zmq.PUB, f"ipc://{place}/stream")
        self.estimate = documented("/taxeld/estimate")[1]
        self._socket.bind(self.endpoint)

    def say(self, **changed: Any) -> dict[str, Any]:
        """An estimate of a scan of now; → its map."""
        message = {**self.estimate, "t": time.time(), **changed}
        self._send(topics.ESTIMATE, message)
        return message

    def say_all(self) -> dict[str, Any]:
        """Health, and an estimate; → its map."""
        self._send(topics.HEALTH, documented("/taxeld/health")[1])
        return self.say()

    def _send(self, topic: bytes, message: dict[str, Any]) -> None:
        self._socket.send_multipart([topic, msgpack.packb(message), b"0.0"])


class Robot(End):
    """The daemon's end of the robot's poses."""

    def __init__(self, place: Path) -> None:
        super().__init__(zmq.SUB, f"ipc://{place}/robot")
        self._socket.setsockopt(zmq.SUBSCRIBE, topics.SENSOR_POSE)
        self._socket.connect(self.endpoint)

    def pose(self) -> dict[str, float] | None:
        if not self._socket.poll(20):
            return None
        _, body, _ = self._socket.recv_multipart()
        return msgpack.unpackb(body)  # type: ignore[no-any-return]


@contextlib.contextmanager
def running(*command: str) -> "Iterator[subprocess.Popen[str]]":
    """A process that is ended with the context."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT
    )
    with process:
        try:
            yield process
        finally:
            process.terminate()
            process.send_signal(signal.SIGCONT)  # one that was stopped ends as well
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE_S)
            process.kill()


def bridge(*arguments: str) -> Any:
    return running(sys.executable, "-m", "taxeld_ros2.cli", *arguments)
