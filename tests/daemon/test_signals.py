"""What an operator and a service manager tell a daemon, and what it tells them."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from taxeld.service.notify import Notifier
from tests.rig.clocks import Clock
from tests.rig.configurations import configuration
from tests.rig.logged import warnings
from tests.rig.processes import taxeld

DEADLINE_S = 60.0


class Running:
    """A daemon that is ready, and the lines it has logged."""

    def __init__(self, place: Path, *, stderr: int | None = None, redirect: str = "") -> None:
        """`stderr`: in place of a file; `redirect`: as a shell is told to."""
        self._place = place
        config = configuration(place)
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
                str(config),
            ],
            stderr=self._log if stderr is None else stderr,
            env={**os.environ, **environ(self.manager, WATCHDOG_USEC="200000")},
        )
        assert self.manager.recv(4096) == b"READY=1"

    def goes_on(self) -> None:
        """Wait until the loop has told ten times that it lives."""
        for _ in range(10):
            while b"WATCHDOG=1" not in self.manager.recv(4096):
                pass

    def log(self) -> list[str]:
        return warnings((self._place / "log").read_text(encoding="utf-8"))

    def ends_by(self, number: int) -> int:
        """The exit status after a signal."""
        self.process.send_signal(number)
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


@pytest.mark.check
@pytest.mark.smoke
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGQUIT, signal.SIGHUP])
def test_a_daemon_says_how_it_is_and_ends_in_order(daemon: Running, number: int) -> None:
    said = [daemon.manager.recv(4096).decode() for _ in range(3)]
    status = "STATUS=starting, not valid, contacts 0, overruns 0"
    assert sorted(said) == [status, "WATCHDOG=1", "WATCHDOG=1"]
    assert daemon.ends_by(number) == 0
    assert heard(daemon.manager)[-1] == "STOPPING=1"
    assert all(line.startswith("status: stale") for line in daemon.log())


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


@pytest.mark.check
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGTERM, 0), (signal.SIGXCPU, -signal.SIGXCPU), (signal.SIGABRT, -signal.SIGABRT)],
)
def test_standard_error_that_nobody_reads_stops_neither_the_loop_nor_its_end(
    tmp_path: Path, full_pipe: int, number: int, status: int
) -> None:
    with contextlib.closing(Running(tmp_path, stderr=full_pipe)) as daemon:
        daemon.goes_on()
        assert daemon.ends_by(number) == status


@pytest.mark.check
@pytest.mark.parametrize("redirect", ["2>&-", "<&- >&- 2>&-"], ids=["stderr", "all"])
def test_a_standard_stream_that_is_closed_leads_nowhere(tmp_path: Path, redirect: str) -> None:
    with contextlib.closing(Running(tmp_path, redirect=redirect)) as daemon:
        daemon.goes_on()
        open_files = Path(f"/proc/{daemon.process.pid}/fd")
        closed = (0, 1, 2) if "<" in redirect else (2,)
        assert {(open_files / str(number)).readlink().name for number in closed} == {"null"}
        assert daemon.ends_by(signal.SIGTERM) == 0


@pytest.mark.check
@pytest.mark.parametrize("number", [signal.SIGXCPU, signal.SIGABRT])
def test_a_loop_that_does_not_pause_says_where_it_is_and_ends(daemon: Running, number: int) -> None:
    assert daemon.ends_by(number) == -number
    assert any("service/clock.py" in line or "service/loop.py" in line for line in daemon.log())


@pytest.fixture
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[socket.socket]:
    """A service manager's socket, in the file system or in the abstract name space."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        abstract = getattr(request, "param", "path") == "abstract"
        bound.bind(f"\0taxeld-test-{os.getpid()}" if abstract else str(tmp_path / "notify"))
        bound.settimeout(DEADLINE_S)
        yield bound


def environ(manager: socket.socket, **more: str) -> dict[str, str]:
    name = manager.getsockname()
    return {"NOTIFY_SOCKET": f"@{name[1:].decode()}" if isinstance(name, bytes) else name, **more}


def heard(manager: socket.socket) -> list[str]:
    manager.setblocking(False)
    messages = []
    try:
        while True:
            messages.append(manager.recv(4096).decode())
    except BlockingIOError:
        return messages


def ticks(notifier: Notifier, seconds: float) -> None:
    """A loop at 100 Hz on a fake clock."""
    clock = Clock()
    while clock.now < seconds:
        notifier.tick(clock.now, lambda now_s: f"{now_s:.1f} s")
        clock.sleep(0.01)


@pytest.mark.parametrize("manager", ["path", "abstract"], indirect=True)
def test_the_watchdog_is_fed_by_ticks_at_half_its_time_and_the_status_said_each_second(
    manager: socket.socket,
) -> None:
    notifier = Notifier(environ(manager, WATCHDOG_USEC="1000000", WATCHDOG_PID=str(os.getpid())))
    notifier.ready()
    ticks(notifier, 2.95)
    notifier.stopping()
    said = heard(manager)
    assert said.count("WATCHDOG=1") == 6
    others = [message for message in said if message != "WATCHDOG=1"]
    assert others == ["READY=1", *(f"STATUS={second}.0 s" for second in range(3)), "STOPPING=1"]


@pytest.mark.parametrize(
    "watch", [{}, {"WATCHDOG_USEC": "soon"}, {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}]
)
def test_without_a_watch_on_this_process_no_sign_of_life_is_sent(
    manager: socket.socket, watch: dict[str, str]
) -> None:
    notifier = Notifier(environ(manager, **watch))
    ticks(notifier, 2.95)
    notifier.stopping()
    assert "WATCHDOG=1" not in heard(manager)


def test_a_manager_that_is_slow_or_gone_holds_nobody_up(manager: socket.socket) -> None:
    notifier = Notifier(environ(manager, WATCHDOG_USEC="20000"))
    ticks(notifier, 100.0)  # far more than its socket holds
    first = heard(manager)
    assert 0 < first.count("WATCHDOG=1") < 10_000
    ticks(notifier, 100.0)
    manager.close()
    ticks(notifier, 1.0)
    notifier.stopping()


@pytest.mark.check
def test_a_daemon_whose_device_is_away_is_ready_and_says_what_it_waits_for(
    manager: socket.socket, tmp_path: Path
) -> None:
    device, said = tmp_path / "skin", os.environ | environ(manager)
    config = configuration(tmp_path, source={"kind": "serial", "channel": device})
    with taxeld("run", config, env=said, stderr=subprocess.PIPE) as process:
        said = [manager.recv(4096).decode() for _ in range(3)]
        reason = f"source.channel: cannot open {device} (it is not there; is it plugged in?)"
        assert said == ["READY=1", *[f"STATUS=waiting, {reason}"] * 2]
        process.send_signal(signal.SIGTERM)
        said = warnings(process.communicate(timeout=DEADLINE_S)[1])
        assert said[0] == f"{reason}; waiting for it"
        assert all(line.startswith("status: stale") for line in said[1:])
        assert process.returncode == 0
