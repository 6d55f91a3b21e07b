"""What an operator and a service manager tell a daemon, and what it tells them."""

import contextlib
import logging
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.analytic import Projection
from taxeld.service import log
from taxeld.service.notices import Notices
from taxeld.service.notify import Notifier
from taxeld.stream import client
from taxeld_protocol.decoder import Scan
from tests.rig.clocks import Clock, until
from tests.rig.configurations import Table, config, configuration
from tests.rig.logged import warnings
from tests.rig.processes import PIPES, taxeld
from tests.rig.recorded import LiveSkin
from tests.rig.simulated_skin import SimulatedSkin

DEADLINE_S = 60.0


class Running:
    """A daemon that is ready, and the lines it has logged."""

    def __init__(
        self, place: Path, *, stderr: int | None = None, redirect: str = "", **tables: Table
    ) -> None:
        """`stderr`: in place of a file; `redirect`: as a shell is told to; `tables`: of its
        configuration."""
        self._place = place
        config = configuration(place, **tables)
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
    tmp_path: Path,
) -> None:
    device = tmp_path / "skin"
    source = {"kind": "serial", "channel": device}
    with contextlib.closing(Running(tmp_path, source=source)) as daemon:
        reason = f"source.channel: cannot open {device} (it is not there; is it plugged in?)"
        while (said := daemon.manager.recv(4096).decode()) == "WATCHDOG=1":
            pass
        assert said == f"STATUS=waiting, {reason}"
        assert daemon.ends_by(signal.SIGTERM) == 0
        assert daemon.log()[0] == f"{reason}; waiting for it"


SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
RECORD = logging.LogRecord("taxeld", logging.WARNING, "", 0, "a line\nand another", None, None)


def test_the_journal_is_told_the_priority_of_each_line(tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as stream:
        found = os.fstat(stream.fileno())
        environ = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        assert log.formatter(stream.fileno(), environ).format(RECORD) == "<4>a line\n<4>and another"
        elsewhere = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino + 1}"}
        assert "<4>" not in log.formatter(stream.fileno(), elsewhere).format(RECORD)


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> Iterator[Callable[[], list[str]]]:
    """→ what was logged since asked last."""

    def taken() -> list[str]:
        lines = [f"{record.levelname}: {record.getMessage()}" for record in caplog.records]
        caplog.clear()
        return lines

    with caplog.at_level(logging.INFO, logger="taxeld"):
        yield taken


@pytest.fixture
def estimate(disc_model: ObservationModel) -> Estimate:
    first = Estimator(disc_model, Projection(disc_model), FilterConfig()).estimate
    return replace(first, status=Status.SEARCHING)


def notices(pipeline: Pipeline | None = None) -> Notices:
    return Notices(SimpleNamespace(pipeline=pipeline), ["box"])  # type: ignore[arg-type]


def test_a_change_of_status_is_logged_once(
    estimate: Estimate, logged: Callable[[], list[str]]
) -> None:
    told, stale = notices(), replace(estimate, status=Status.STALE)
    sure = replace(estimate, p=0.9962, radius_m=0.0088)
    valid = r"x \S+ m, y \S+ m, yaw \S+ rad, p 99.6%, radius 8.8 mm"
    for now_s, one, why, reason, line in (
        (0.0, estimate, Why.UNTOUCHED, "touch it", "INFO: searching, not valid, .*: touch it"),
        (1.0, estimate, Why.UNTOUCHED, "touch it", ""),
        (10.0, estimate, Why.VAGUE, "again", "INFO: searching, not valid, 0 contacts: again"),
        (20.0, stale, Why.NO_SCAN, "no scan", "WARNING: stale, not valid, 0 contacts: no scan"),
        (30.0, sure, Why.VALID, "", f"INFO: searching, valid, 0 contacts, {valid}"),
    ):
        told.estimate(one, why, reason, now_s)
        assert re.fullmatch(line.replace(": ", ": status: ", 1), "".join(logged()))


def test_a_status_that_flaps_is_logged_ever_less_often_and_the_last_one_is_logged(
    estimate: Estimate, logged: Callable[[], list[str]]
) -> None:
    told, stale = notices(), replace(estimate, status=Status.STALE)
    for k in range(400):  # twenty seconds, as often as estimates are published
        one = (estimate, Why.UNTOUCHED, "") if k // 10 % 2 else (stale, Why.NO_SCAN, "")
        told.estimate(*one, 0.05 * k)
    assert 3 <= len(logged()) <= 8
    for k in range(400, 700):
        told.estimate(estimate, Why.VALID, "", 0.05 * k)
    assert logged()[-1].startswith("INFO: status: searching, valid")
    told.estimate(stale, Why.NO_SCAN, "no scan comes", 60.0)
    assert len(logged()) == 1, "at once, once it was calm"


def hub_of(modules: int) -> tuple[Pipeline, SimulatedSkin]:
    """A pipeline for the layout of eight modules, and a skin whose hub has so many of them."""
    whole = layouts.load(SPEC)
    loaded = bundle.load("box", whole, 0.005)
    skin = SimulatedSkin(whole, noise=5.0)
    pipeline = Pipeline(config(), [whole], [loaded.model], choice.samples([loaded], FilterConfig()))
    for _ in range(30):
        list(pipeline.advance([cut(skin.scan(), modules)], skin.t))
    return pipeline, skin


def cut(scan: Scan, modules: int) -> Scan:
    """The scan of a hub that has the first so many modules alone."""
    table = scan.table[:modules]
    counts = scan.counts[: sum(module.channels for module in table)]
    return replace(scan, table=table, counts=counts)


def test_what_is_wrong_with_poses_and_modules_is_logged_once_and_so_is_its_end(
    logged: Callable[[], list[str]],
) -> None:
    pipeline, skin = hub_of(5)
    told = notices(pipeline)

    def looked(fault: str) -> list[str]:
        """Eight looks, a second each."""
        logged()
        for _ in range(8):
            told.inputs(fault, 0.0)
        return logged()

    missing = "3 of its 8 modules are on no hub (SUI 6, 7, 8)"
    assert looked("no pose comes") == [
        "WARNING: sensor_pose: no pose comes",
        "INFO: hub 1 sends: 5 modules, 5 of them in the layout",
        f"WARNING: skin.layout: {missing}; estimates are not valid: give the layout of this skin, "
        "or see to its modules",
    ]
    assert pipeline.health()["missing_modules"] == [6, 7, 8]
    touched = replace(pipeline.estimate, contacts=1, status=Status.AMBIGUOUS, p=0.5)
    assert pipeline.freshness.why(touched) is Why.MODULES_MISSING
    for stage in pipeline.stages:
        allowed = replace(stage.config.skin, missing_modules=3)
        stage.config = replace(stage.config, skin=allowed)
    list(pipeline.advance([cut(skin.scan(), 5)], skin.t))
    assert pipeline.freshness.why(touched) is Why.VALID
    (line,) = [line for line in looked("") if "layout" in line]
    assert line == f"WARNING: skin.layout: {missing}; is it the layout of this skin?"
    list(pipeline.advance([replace(skin.scan(), table_version=99)], skin.t))
    assert looked("") == [
        "INFO: hub 1 sends: 8 modules, 8 of them in the layout",
        "INFO: skin.layout: all its modules are there",
    ]


def test_a_daemon_says_when_it_is_ready_with_what(tmp_path: Path) -> None:
    with LiveSkin(tmp_path, touches=0, period_s=0.02) as skin:
        config = configuration(tmp_path, source=skin.source)
        with taxeld("run", config, **PIPES) as daemon:
            lines = [daemon.stderr.readline()]
            while "in the layout" not in lines[-1]:
                lines.append(daemon.stderr.readline())
            daemon.terminate()
    assert "ready: skin cylinder:rows=5" in lines[0]
    assert "80 taxels; object 003_cracker_box; samples by " in lines[0]
    assert f"source can {tmp_path}/skin, open" in lines[0]
    assert f"streams at ipc://{tmp_path}/stream; control at ipc://{tmp_path}/control" in lines[0]
    assert lines[-1].endswith("hub 1 sends: 8 modules, 8 of them in the layout\n")


def test_a_run_with_a_log_level_logs_nothing_below_it(tmp_path: Path) -> None:
    with taxeld("run", configuration(tmp_path, log={"level": "error"}), **PIPES) as daemon:
        until(lambda: client.ask(f"ipc://{tmp_path}/control", "info", timeout_s=0.5))
        daemon.terminate()
        assert daemon.communicate() == ("", "")
