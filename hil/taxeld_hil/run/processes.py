"""The processes beside the harness: the daemon, and a subscriber that may die."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.stream import client
from taxeld_hil.scenario.scenario import Scenario

GRACE_S = 5.0


class Process:
    """A command of this project's; `what` names it in messages."""

    def __init__(self, what: str, module: str, *args: str, quiet: bool = False) -> None:
        """`quiet`: what it prints is kept for `has_printed`."""
        self.what = what
        self._command = [sys.executable, "-m", module, *args]
        self._quiet = quiet
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def is_running(self) -> bool:
        """Whether it was started, and neither killed nor stopped."""
        return self._process is not None

    @property
    def pid(self) -> int:
        """Of the running process."""
        assert self._process is not None  # noqa: S101  (asked while it runs)
        return self._process.pid

    def start(self) -> None:
        out = subprocess.PIPE if self._quiet else None
        self._process = subprocess.Popen(self._command, stdout=out)  # noqa: S603
        if self._process.stdout is not None:
            os.set_blocking(self._process.stdout.fileno(), False)

    def check(self) -> None:
        """Raises SetupError where it has ended by itself; its own message says why."""
        if self._process is not None and self._process.poll() is not None:
            status = self._process.returncode
            self._process = None
            raise SetupError(f"{self.what} ended early, with status {status}")

    def has_printed(self) -> bool:
        """Whether it has printed anything since this was asked last."""
        if self._process is None or self._process.stdout is None:
            return False
        return bool(self._process.stdout.read(65536))

    def kill(self) -> None:
        """As a crash would."""
        if self._process is not None:
            self._process.kill()
            self._wait(self._process)
            self._process = None

    def stop(self) -> None:
        """Raises SetupError where it does not stop as asked."""
        if self._process is None:
            return
        process, self._process = self._process, None
        process.send_signal(signal.SIGTERM)
        try:
            status = self._wait(process, GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            self._wait(process)
            raise SetupError(f"{self.what} did not stop within {GRACE_S:g} s") from None
        if status:
            raise SetupError(f"{self.what} ended with status {status}")

    @staticmethod
    def _wait(process: subprocess.Popen[bytes], timeout_s: float | None = None) -> int:
        status = process.wait(timeout_s)
        if process.stdout is not None:
            process.stdout.close()
        return status


class Processes:
    """The daemon, and a subscriber that shows by printing that it works; either may be killed."""

    def __init__(self, config: Path, endpoint: str, scenario: Scenario, log_level: str) -> None:
        """`config`: the daemon's file; `endpoint`: where it publishes; `log_level`: its log's."""
        where = (
            "--endpoint", endpoint, "--bundle", scenario.bundle, "--layout", scenario.layout,
        )  # fmt: skip
        self.daemon = Process(
            "the daemon", "taxeld.cli", "run", "--log-level", log_level, str(config)
        )
        self._subscriber = Process("the subscriber", "taxeld_hil.cli", "watch", *where, quiet=True)

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
            if fails(kind) and process.is_running:
                process.kill()
                events.append(f"{name} killed")
            elif not fails(kind) and not process.is_running:
                process.start()
                events.append(f"{name} started")
        if self._subscriber.has_printed():
            events.append("subscriber printed")
        return events

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
        """Raises SetupError where one does not stop as asked."""
        self._subscriber.stop()
        self.daemon.stop()

    def kill(self) -> None:
        self._subscriber.kill()
        self.daemon.kill()
