"""The processes beside the harness: the daemon, and a subscriber that may die."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

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


DAEMON, SUBSCRIBED = "daemon_killed", "subscriber_dead"  # by the kinds of faults that kill them
NAMES = {DAEMON: "daemon", SUBSCRIBED: "subscriber"}


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
        self._commands = {
            DAEMON: ["-m", "taxeld.cli", "run", str(file)],
            SUBSCRIBED: ["-c", SUBSCRIBER, stream],
        }
        self._printed = stack.enter_context((place / "printed").open("wb"))
        self._bytes = 0  # bytes printed by the subscriber
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        stack.callback(self._kill_all)
        for kind in self._commands:
            self._start(kind)

    @property
    def pid(self) -> int:
        """Process id of the daemon, while it runs."""
        return self._running[DAEMON].pid

    def messages(self, wait_ms: int) -> Iterator[tuple[bytes, bytes]]:
        """Topics and bodies of what has come; the first is waited for."""
        while self._stream.poll(wait_ms):
            topic, body, _ = self._stream.recv_multipart()
            yield topic, body
            wait_ms = 0

    def act(self, fails: Callable[[str], bool]) -> list[str]:
        """Kill and start what `fails` says of each kind of fault; → what has happened.

        Raises:
            SetupError: one has ended by itself; its own message says why.
        """
        events = []
        for kind, name in NAMES.items():
            process = self._running.get(kind)
            if process is not None and process.poll() is not None:
                raise SetupError(f"the {name} ended early, with status {process.returncode}")
            if fails(kind) and process is not None:
                self._kill(kind)
                events.append(f"{name} killed")
            elif not fails(kind) and process is None:
                self._start(kind)
                events.append(f"{name} started")
        before, self._bytes = self._bytes, (self._place / "printed").stat().st_size
        return [*events, "subscriber printed"] if self._bytes > before else events

    def reset(self) -> None:
        """Have the daemon forget the object. Raises SetupError where it does not answer."""
        if client.ask(f"ipc://{self._place}/control", "reset") is None:
            raise SetupError("the daemon did not answer within 2 s")

    def stop(self) -> None:
        """Raises SetupError where the daemon does not stop as asked."""
        if (process := self._running.get(DAEMON)) is None:
            return
        process.terminate()
        try:
            status = process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            raise SetupError(f"the daemon did not stop within {GRACE_S:g} s") from None
        if status:
            raise SetupError(f"the daemon ended with status {status}")

    def _start(self, kind: str) -> None:
        command = [sys.executable, *self._commands[kind]]
        out = self._printed if kind == SUBSCRIBED else None
        self._running[kind] = subprocess.Popen(command, stdout=out)  # noqa: S603

    def _kill_all(self) -> None:
        for kind in [*self._running]:
            self._kill(kind)

    def _kill(self, kind: str) -> None:
        """End it as a crash would."""
        process = self._running.pop(kind)
        process.kill()
        process.wait()
