"""Signals to a real daemon: none ends it but those that should, and those end it in order."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.rig.clocks import until
from tests.rig.configurations import QUIET, configuration
from tests.rig.logged import warnings

from .test_notify import environ

pytestmark = pytest.mark.check

DEADLINE_S = 60.0


class Running:
    """A daemon that is ready, and the lines it has logged."""

    def __init__(self, place: Path, *, stderr: int | None = None, redirect: str = "") -> None:
        """`stderr`: in place of a file; `redirect`: as a shell is told to."""
        self._place = place
        self.config = self.configured(log={"level": "info"})
        self._log = (place / "log").open("w+", encoding="utf-8")
        self.manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.manager.bind(str(place / "notify"))
        self.manager.settimeout(DEADLINE_S)
        self.process = subprocess.Popen(
            [
                "sh",
                "-c",
                f'exec "$0" -m taxeld.cli run "$1" {redirect}',
                sys.executable,
                str(self.config),
            ],
            stderr=self._log if stderr is None else stderr,
            env={**os.environ, **environ(self.manager, WATCHDOG_USEC="200000")},
        )
        assert self.manager.recv(4096) == b"READY=1"
        self.send = self.process.send_signal

    def goes_on(self) -> None:
        """Wait until the loop has told ten times that it lives."""
        for _ in range(10):
            while b"WATCHDOG=1" not in self.manager.recv(4096):
                pass

    def configured(self, **tables: dict[str, object]) -> Path:
        return configuration(self._place, source=QUIET, **tables)

    def log(self) -> list[str]:
        return warnings((self._place / "log").read_text(encoding="utf-8"))

    def wait_for(self, text: str) -> str:
        """The line with this text."""
        line: str = until(lambda: next((line for line in self.log() if text in line), ""))
        return line

    def ends_by(self, number: int) -> int:
        """The exit status after a signal."""
        self.send(number)
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self.manager.close()
        self._log.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Running]:
    made = Running(tmp_path)
    yield made
    made.close()


USR = (signal.SIGUSR1, signal.SIGUSR2)
SURVIVED = (*USR, signal.SIGALRM, signal.SIGHUP, signal.SIGPIPE)


@pytest.mark.parametrize("at_once", [False, True])
def test_no_signal_of_an_operator_ends_a_daemon_but_those_that_should(
    daemon: Running, at_once: bool
) -> None:
    for number in (signal.SIGSTOP,) * at_once + SURVIVED + (signal.SIGCONT,):
        daemon.send(number)
    estimate, health = daemon.wait_for("estimate: "), daemon.wait_for("health: ")
    assert any("service/loop.py" in line or "service/clock.py" in line for line in daemon.log())
    assert json.loads(health.removeprefix("health: "))["uptime_s"] > 0.0
    assert "map" in json.loads(estimate.removeprefix("estimate: "))
    assert daemon.ends_by(signal.SIGTERM) == 0


@pytest.mark.smoke
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT])
def test_who_ends_a_daemon_ends_it_in_order(daemon: Running, number: int) -> None:
    assert daemon.ends_by(number) == 0
    assert all(line.startswith("status: stale") for line in daemon.log())


def test_usr1_ends_no_daemon_however_often_it_comes(daemon: Running) -> None:
    for _ in range(1000):
        daemon.send(signal.SIGUSR1)
        assert daemon.process.poll() is None
        time.sleep(0.0005)
    assert daemon.ends_by(signal.SIGTERM) == 0


@pytest.fixture
def full_pipe() -> Iterator[int]:
    """The end to write to, where nothing more fits in and nobody reads."""
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    for size in (4096, 1):
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(theirs, bytes(size))
    os.set_blocking(theirs, True)
    yield theirs
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGTERM, 0), (signal.SIGXCPU, -signal.SIGXCPU), (signal.SIGABRT, -signal.SIGABRT)],
)
def test_standard_error_that_nobody_reads_stops_neither_the_loop_nor_its_end(
    tmp_path: Path, full_pipe: int, number: int, status: int
) -> None:
    with contextlib.closing(Running(tmp_path, stderr=full_pipe)) as daemon:
        daemon.send(signal.SIGUSR1)
        daemon.goes_on()
        assert daemon.ends_by(number) == status


@pytest.mark.parametrize("redirect", ["2>&-", "<&- >&- 2>&-"], ids=["stderr", "all"])
def test_a_standard_stream_that_is_closed_leads_nowhere(tmp_path: Path, redirect: str) -> None:
    with contextlib.closing(Running(tmp_path, redirect=redirect)) as daemon:
        daemon.send(signal.SIGUSR1)
        daemon.goes_on()
        open_files = Path(f"/proc/{daemon.process.pid}/fd")
        closed = (0, 1, 2) if "<" in redirect else (2,)
        assert {(open_files / str(number)).readlink().name for number in closed} == {"null"}
        assert daemon.ends_by(signal.SIGTERM) == 0


@pytest.mark.parametrize("number", [signal.SIGXCPU, signal.SIGABRT])
def test_a_loop_that_does_not_pause_says_where_it_is_and_ends(daemon: Running, number: int) -> None:
    assert daemon.ends_by(number) == -number
    assert any("service/clock.py" in line or "service/loop.py" in line for line in daemon.log())


@pytest.mark.parametrize(
    ("tables", "begin", "end"),
    [
        (
            {"log": {"level": "debug"}, "filter": {"seed": 7}},
            "config.toml: read again, log.level is debug; ",
            "a restart is needed for what changed in filter",
        ),
        ({"log": {"level": "loud"}}, "log.level: must be one of", "; going on as before"),
    ],
    ids=["new", "with a fault"],
)
def test_hup_takes_the_log_level_of_a_configuration_without_faults(
    daemon: Running, tables: dict[str, dict[str, object]], begin: str, end: str
) -> None:
    daemon.configured(**tables)
    daemon.send(signal.SIGHUP)
    line = daemon.wait_for("log.level")
    assert line.removeprefix(f"{daemon.config.parent}/").startswith(begin)
    assert line.endswith(end)
