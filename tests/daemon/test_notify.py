"""What the service manager is told: on a real datagram socket, and by a real daemon."""

import os
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from taxeld.service.notify import Notifier
from tests.rig.clocks import Clock
from tests.rig.configurations import QUIET, configuration
from tests.rig.logged import warnings
from tests.rig.processes import taxeld

DEADLINE_S = 60.0


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


def test_a_daemon_is_ready_says_how_it_is_feeds_the_watchdog_and_says_when_it_stops(
    manager: socket.socket, tmp_path: Path
) -> None:
    said = os.environ | environ(manager, WATCHDOG_USEC="200000")
    with taxeld("run", configuration(tmp_path, source=QUIET), env=said) as process:
        first = [manager.recv(4096).decode() for _ in range(5)]
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE_S) == 0
    assert first[0] == "READY=1"
    assert sorted(first[1:4]) == [
        "STATUS=starting, not valid, contacts 0, overruns 0",
        "WATCHDOG=1",
        "WATCHDOG=1",
    ]
    assert heard(manager)[-1] == "STOPPING=1"


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
