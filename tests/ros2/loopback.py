"""DDS between processes of this machine alone, and what the tests of the bridge share."""

import functools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zmq

from taxeld.stream import messages
from taxeld.stream.publisher import Publisher
from tests.daemon.test_stream_document import documented

PATIENCE_S = 60.0
DOMAIN = 100 + os.getpid() % 100  # of this run of the tests, as others may run beside it
# No multicast: participants find each other at the ports of the first few of a domain
URI = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/>"
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>"
    "<Peers><Peer address='127.0.0.1'/></Peers><SPDPInterval>300ms</SPDPInterval></Discovery>"
    "</Domain></CycloneDDS>"
)
ENVIRONMENT = {**os.environ, "CYCLONEDDS_URI": URI, "ROS_DOMAIN_ID": str(DOMAIN)}


example = functools.cache(lambda topic: documented(topic)[1])


class Daemon:
    """What a daemon publishes, on its own publisher, as the document has it."""

    def __init__(self, place: Path) -> None:
        self.endpoint = f"ipc://{place}/stream"
        self._context: zmq.Context[Any] = zmq.Context()
        _, info = documented("/taxeld/info")
        self._publisher = Publisher(self._context, 100, info)
        self._publisher.bind((self.endpoint,), "publish.endpoints")
        self.estimate = documented("/taxeld/estimate")[1]
        self.seq = 0

    def serve(self) -> None:
        self._publisher.greet(time.monotonic(), time.time())

    def say(self, **changed: Any) -> dict[str, Any]:
        """An estimate of a scan of now; → its map."""
        self.serve()
        self.seq += 1
        message = {**self.estimate, "seq": self.seq, "t": time.time(), **changed}
        self._publisher.send(messages.ESTIMATE, message, message["t"])
        return message

    def send(self, topic: bytes, **changed: Any) -> None:
        """The document's example of another topic."""
        self.serve()
        self._publisher.send(topic, {**example(topic.decode()), **changed}, time.time())

    def close(self) -> None:
        self._publisher.close()
        self._context.term()


@contextmanager
def bridge(*arguments: str) -> "Iterator[subprocess.Popen[str]]":
    """The bridge as a process; what it logs is in `stderr`."""
    command = [sys.executable, "-m", "taxeld_ros2.cli", *arguments]
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        yield running
    finally:
        running.terminate()
        running.wait(PATIENCE_S)
        assert running.stderr is not None
        running.stderr.close()


class Lines:
    """What a process prints, as it comes."""

    def __init__(self, command: list[str]) -> None:
        self.lines: list[str] = []
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
        )
        self._reading = threading.Thread(target=self._read)
        self._reading.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        self.lines.extend(iter(self._process.stdout.readline, ""))

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def close(self) -> None:
        self._process.kill()
        self._process.wait(PATIENCE_S)
        self._reading.join()
        assert self._process.stdout is not None
        self._process.stdout.close()


def until(done: Callable[[], Any], meanwhile: Callable[[], object] = lambda: None) -> Any:
    """What `done` gives once it is true; `meanwhile` is called again and again."""
    deadline = time.monotonic() + PATIENCE_S
    while not (found := done()):
        assert time.monotonic() < deadline, "nothing came"
        meanwhile()
        time.sleep(0.02)
    return found
