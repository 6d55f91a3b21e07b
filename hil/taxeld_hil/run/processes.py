"""The processes beside the harness: the daemon, and a subscriber that may die."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import zmq

from taxeld.errors import SetupError
from taxeld.stream import client, topics

GRACE_S = 5.0
SUBSCRIBER = """
import sys, zmq
socket = zmq.Context().socket(zmq.SUB)
socket.connect(sys.argv[1])
socket.subscribe(b"/taxeld/estimate")
while True:
    print(len(socket.recv_multipart()), flush=True)
"""


class Process:
    """A process of this Python's; `what` names it in messages."""

    def __init__(self, what: str, *args: str, out: IO[bytes] | None = None) -> None:
        """`out`: a file that gets what it prints."""
        self.what, self._out = what, out
        self._command = [sys.executable, *args]
        self.start()

    def start(self) -> None:
        self.running: subprocess.Popen[bytes] | None
        self.running = subprocess.Popen(self._command, stdout=self._out)  # noqa: S603

    @property
    def pid(self) -> int:
        """Process id of the running process."""
        assert self.running is not None  # noqa: S101  (asked while it runs)
        return self.running.pid

    def check(self) -> None:
        """Raises SetupError where it has ended by itself; its own message says why."""
        if self.running is not None and self.running.poll() is not None:
            status, self.running = self.running.returncode, None
            raise SetupError(f"{self.what} ended early, with status {status}")

    def kill(self) -> None:
        """End it as a crash would."""
        if self.running is not None:
            self.running.kill()
            self.running.wait()
            self.running = None

    def stop(self) -> None:
        """Raises SetupError where it does not stop as asked."""
        if self.running is None:
            return
        self.running.send_signal(signal.SIGTERM)
        try:
            status = self.running.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            raise SetupError(f"{self.what} did not stop within {GRACE_S:g} s") from None
        finally:
            self.kill()
        if status:
            raise SetupError(f"{self.what} ended with status {status}")


class LiveDaemon:
    """The daemon, a subscriber that shows by printing that it works, and the harness's own
    subscription; both processes may be killed."""

    def __init__(self, stack: ExitStack, place: Path, config: str) -> None:
        """`config`: the text of its file, which has its sockets in `place`. All ends with the
        stack."""
        file, stream, self._place = place / "taxeld.toml", f"ipc://{place}/stream", place
        file.write_text(config, encoding="utf-8")
        context = stack.enter_context(zmq.Context())
        self._stream: zmq.Socket[Any] = stack.enter_context(context.socket(zmq.SUB))
        self._stream.setsockopt(zmq.LINGER, 0)
        self._stream.connect(stream)
        for topic in (topics.ESTIMATE, topics.TAXELS, topics.HEALTH):
            self._stream.setsockopt(zmq.SUBSCRIBE, topic)
        self._printed = stack.enter_context((place / "printed").open("wb"))
        self._bytes = 0  # bytes printed by the subscriber
        self.process = Process("the daemon", "-m", "taxeld.cli", "run", str(file))
        stack.callback(self.process.kill)
        to = "-c", SUBSCRIBER, stream
        self._subscriber = Process("the subscriber", *to, out=self._printed)
        stack.callback(self._subscriber.kill)

    def messages(self, wait_ms: int) -> Iterator[tuple[bytes, bytes]]:
        """Topics and bodies of what has come; the first is waited for."""
        while self._stream.poll(wait_ms):
            topic, body, _ = self._stream.recv_multipart()
            yield topic, body
            wait_ms = 0

    def act(self, fails: Callable[[str], bool]) -> list[str]:
        """Kill and start what `fails` says of each kind of fault; → what has happened.

        Raises:
            SetupError: one has ended by itself.
        """
        events = []
        for kind, name, process in (
            ("daemon_killed", "daemon", self.process),
            ("subscriber_dead", "subscriber", self._subscriber),
        ):
            process.check()
            if fails(kind) and process.running:
                process.kill()
                events.append(f"{name} killed")
            elif not fails(kind) and not process.running:
                process.start()
                events.append(f"{name} started")
        before, self._bytes = self._bytes, (self._place / "printed").stat().st_size
        return [*events, "subscriber printed"] if self._bytes > before else events

    def reset(self) -> None:
        """Have the daemon forget the object. Raises SetupError where it does not answer."""
        if client.ask(f"ipc://{self._place}/control", "reset") is None:
            raise SetupError("the daemon did not answer within 2 s")

    def stop(self) -> None:
        """Raises SetupError where the daemon does not stop as asked."""
        self._subscriber.kill()
        self.process.stop()
