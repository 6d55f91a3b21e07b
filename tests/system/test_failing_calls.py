"""A daemon that records, and keeps what it learns, loses nothing else where a system call fails."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from taxeld.source import session
from tests.rig.array_skin import LAYOUT, ArraySkin
from tests.rig.clocks import until
from tests.rig.configurations import configuration

pytestmark = pytest.mark.check

SCANS, SENT = 12, 100  # scans in the recording, or sent at all, before the daemon is ended
CALLS, TRIED = 70, 20  # calls that such a run makes, about; those that fail, each in its own run
REASONS = (errno.EIO, errno.ENOSPC)


@pytest.fixture(scope="module")
def preload(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("preload") / "failing_call.so"
    source = Path(__file__).with_name("failing_call.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", made, source, "-ldl"], check=True)
    return made


def recorded(place: Path) -> int:
    file = place / "session" / session.ARRIVALS
    return file.read_bytes().count(b"\xa5array") if file.exists() else 0


def run(place: Path, preload: Path, number: int, reason: int, **more: str) -> tuple[int, str, str]:
    """The exit status of a daemon that has recorded some scans, its log, and which call failed."""
    place.mkdir()
    skin, robot = f"ipc://{place}/skin", f"ipc://{place}/robot"
    config = configuration(
        place,
        source={"kind": "array", "endpoint": skin},
        skin={"layout": LAYOUT},
        sensor_pose={"endpoint": robot},
    )
    told, log = place.with_suffix(".told"), place.with_suffix(".log")
    failing = {
        "LD_PRELOAD": str(preload),
        "FAILING_CALL": str(number),
        "FAILING_ERRNO": str(reason),
        "FAILING_PLACE": f"{place}/",
        "FAILING_TOLD": str(told),
        "STATE_DIRECTORY": str(place / "state"),
    }
    command = [sys.executable, "-m", "taxeld.cli", "run", "--record", place / "session", config]
    with ArraySkin(skin, robot, idle=8) as sender, log.open("w") as stderr:
        process = subprocess.Popen(command, stderr=stderr, env={**os.environ, **failing, **more})
        try:
            until(lambda: process.poll() is not None or "ready: " in log.read_text())
            last = sender.sent + SENT
            is_through = lambda: recorded(place) >= SCANS and (not more or told.exists())  # noqa: E731
            until(lambda: process.poll() is not None or is_through() or sender.sent > last)
            process.send_signal(signal.SIGTERM)
            status = process.wait(60.0)
        finally:
            process.kill()
    return status, log.read_text(), told.read_text() if told.exists() else ""


def test_one_call_that_fails_costs_at_most_what_one_line_names(
    tmp_path: Path, preload: Path
) -> None:
    rng, failed = np.random.default_rng(0), 0
    for k, number in enumerate(rng.choice(np.arange(1, CALLS), TRIED, replace=False).tolist()):
        place, reason = tmp_path / str(number), REASONS[k % len(REASONS)]
        status, log, call = run(place, preload, number, reason)
        case = f"call {number}: {call}{log}"
        assert not {"Traceback", "None:"} & set(log.split()), case
        failed += bool(call)
        if status:  # it never began
            assert (status, log.count("\n")) == (2, 1), case
            assert log.startswith(f"{place}/"), case
            assert os.strerror(reason) in log, case
        elif recorded(place) < SCANS:
            assert f"{place}/session: the recording has ended" in log, case
        assert status or "ready: " in log, case
    assert failed > TRIED // 2


@pytest.mark.parametrize(
    ("name", "number", "reason"),
    [
        ("poll", 5, errno.ENOMEM),  # of the loop at work
        ("memfd_create", 1, errno.EMFILE),  # of what was felt, for clients
        ("sendmsg", 1, errno.ENOMEM),
        ("close", 1, errno.EIO),
    ],
)
def test_a_call_of_the_loop_that_fails_costs_nothing_but_a_moment(
    tmp_path: Path, preload: Path, name: str, number: int, reason: int
) -> None:
    place, only = tmp_path / "run", {"FAILING_NAME": name, "FAILING_PARENT": str(os.getpid())}
    status, log, call = run(place, preload, number, reason, **only)
    assert call.endswith(f" {name}\n")
    assert (status, recorded(place) >= SCANS, "Traceback" in log) == (0, True, False), log
