"""The processes beside the harness: the daemon, and a subscriber that may die."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

from taxeld.config.tables import SceneConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld.stream import client
from taxeld_hil.scenario.scenario import Scenario

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
        self.what = what
        self.running: subprocess.Popen[bytes] | None = None
        self._command = [sys.executable, *args]
        self._out = out

    @property
    def pid(self) -> int:
        """Process id of the running process."""
        assert self.running is not None  # noqa: S101  (asked while it runs)
        return self.running.pid

    def start(self) -> None:
        self.running = subprocess.Popen(self._command, stdout=self._out)  # noqa: S603

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


class Processes:
    """The daemon, and a subscriber that shows by printing that it works; either may be killed."""

    def __init__(self, config: Path, endpoint: str, scenario: Scenario) -> None:
        """`config`: the daemon's file; `endpoint`: where it publishes.

        Raises:
            SetupError: the daemon would refuse the bundle on this layout.
        """
        known = SceneConfig(bundles=scenario.known)
        bundle.load_all(known, [layouts.load(scenario.skin_layout)])
        run = ("run", str(config))
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115  (for as long as this lives)
        self._bytes = 0  # bytes printed by the subscriber
        self.daemon = Process("the daemon", "-m", "taxeld.cli", *run)
        self._subscriber = Process("the subscriber", "-c", SUBSCRIBER, endpoint, out=self._printed)

    def act(self, fails: Callable[[str], bool]) -> list[str]:
        """Kill and start what `fails` says of each kind of fault; → what has happened.

        Raises:
            SetupError: one has ended by itself.
        """
        events = []
        for kind, name, process in (
            ("daemon_killed", "daemon", self.daemon),
            ("subscriber_dead", "subscriber", self._subscriber),
        ):
            process.check()
            if fails(kind) and process.running:
                process.kill()
                events.append(f"{name} killed")
            elif not fails(kind) and not process.running:
                process.start()
                events.append(f"{name} started")
        before, self._bytes = self._bytes, os.fstat(self._printed.fileno()).st_size
        return [*events, "subscriber printed"] if self._bytes > before else events

    @staticmethod
    def reset(control: str) -> None:
        """Have the daemon that answers there forget the object.

        Raises:
            SetupError: it does not answer.
        """
        if client.ask(control, "reset") is None:
            raise SetupError("the daemon did not answer within 2 s")

    def start(self) -> None:
        self.daemon.start()
        self._subscriber.start()

    def stop(self) -> None:
        """Raises SetupError where the daemon does not stop as asked."""
        self._subscriber.kill()
        self.daemon.stop()

    def kill(self) -> None:
        self._subscriber.kill()
        self.daemon.kill()
