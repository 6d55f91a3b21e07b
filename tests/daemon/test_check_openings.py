"""`taxeld check` opens what `taxeld run` opens, and names each fault; and why no daemon answers."""

import ctypes
import fcntl
import getpass
import os
import pty
import socket
import tempfile
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from taxeld.cli import main
from taxeld.commands import check
from taxeld.config import endpoints
from taxeld.stream import client
from tests.rig.commands import printed, refused
from tests.rig.configurations import QUIET, Table, configuration
from tests.rig.given_device import GivenDevice

NAMES = {"publish": "publish.endpoints", "control": "control.endpoint"}
CAPABILITIES = 0x20080522  # version 3 of the kernel's interface
MAY_ALL = 0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory whose name is short enough for a socket."""
    with tempfile.TemporaryDirectory() as made:
        yield Path(made)


@pytest.fixture
def plain_user() -> Iterator[None]:
    """Root is forbidden what others are: modes hold for this thread."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(CAPABILITIES, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: lower, then upper half
    assert libc.capget(header, sets) == 0
    before = sets[0]
    sets[0] &= ~MAY_ALL
    assert libc.capset(header, sets) == 0
    yield
    sets[0] = before
    assert libc.capset(header, sets) == 0


@pytest.fixture
def line() -> Iterator[Path]:
    ours, theirs = pty.openpty()
    yield Path(os.ttyname(theirs))
    os.close(ours)
    os.close(theirs)


def configured(place: Path, device: Path | str = "", **tables: Table) -> Path:
    """A daemon on a serial line, which serves nobody."""
    nobody: dict[str, Table] = {"publish": {"endpoints": []}, "control": {"endpoint": ""}}
    source = {"kind": "serial", "channel": device}
    return configuration(place, **{"source": source, **nobody, **tables})


def test_a_device_of_another_group_is_refused(
    place: Path, line: Path, request: pytest.FixtureRequest
) -> None:
    path = str(configured(place, line))
    line.chmod(0)
    request.getfixturevalue("plain_user")
    assert "permission denied; is this user in the group" in refused("check", path)


@pytest.mark.parametrize(
    ("device", "reason"),
    [
        ("{place}", "it is a directory"),
        ("{place}/file", "it is no serial line"),
        ("{place}/ttyACM0", "it is not there; is it plugged in?"),
    ],
)
def test_a_device_that_cannot_be_opened_is_refused(place: Path, device: str, reason: str) -> None:
    (place / "file").touch()
    device = device.format(place=place)
    told = refused("check", str(configured(place, device)))
    assert told == f"source.channel: cannot open {device} ({reason})\n"


def test_a_device_that_another_process_has_is_refused_unless_a_daemon_runs(
    place: Path, line: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The locks of two open files of one process keep each other out as those of two do."""
    path = str(configured(place, line))
    with line.open("rb", buffering=0) as held:
        assert main(["check", path]) == 0, "who only has it open keeps nobody out"
        capsys.readouterr()
        fcntl.flock(held, fcntl.LOCK_EX)
        told = refused("check", path)
        assert main(["check", "--running", path]) == 0
    assert f"another process has it open; stop that first, 'fuser {line}' tells which" in told


def test_nothing_is_sent_to_a_device(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    for kind in ({"kind": "serial"}, {"kind": "can", "interface": "slcan"}):
        source = kind | {"channel": os.ttyname(theirs)}
        assert main(["check", str(configured(place, source=source))]) == 0
        with pytest.raises(BlockingIOError):
            os.read(ours, 1)
    os.close(ours)
    os.close(theirs)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("key", ["publish", "control"])
@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("", ""),
        ("left", ""),  # by a daemon that was killed
        ("served", "another daemon serves {at}"),
        ("no socket", "{at} is no socket; remove it"),
        ("no directory", "does not exist; the service makes it"),
        ("closed", "cannot bind ipc://{at} (Permission denied); is another daemon there?"),
    ],
)
def test_an_endpoint_that_cannot_be_had_is_refused(
    place: Path, request: pytest.FixtureRequest, key: str, fault: str, words: str
) -> None:
    at = place / "run" / "s"
    at.parent.mkdir()
    named = {"endpoint": f"ipc://{at}"} if key == "control" else {"endpoints": [f"ipc://{at}"]}
    path = str(configured(place, source=QUIET, **{key: named}))
    with socket.socket(socket.AF_UNIX) as other:
        if fault in ("served", "left"):
            other.bind(str(at))
        if fault == "served":
            other.listen()
        elif fault == "left":
            other.close()
        elif fault == "no socket":
            at.touch()
        elif fault == "no directory":
            at.parent.rmdir()
        elif fault == "closed":
            at.parent.chmod(0o555)
            request.getfixturevalue("plain_user")
        if words:
            told = refused("check", path)
            assert told.startswith(f"{NAMES[key]}: ")
            assert words.format(at=at) in told
        else:
            assert main(["check", path]) == 0
        assert main(["check", "--running", path]) == (2 if words and fault != "served" else 0)
        if fault == "closed":
            at.parent.chmod(0o755)


@pytest.mark.parametrize(("flags", "is_down"), [(0x40C0, True), (0x40C1, False)])
def test_an_interface_that_is_down_is_noted(
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    flags: int,
    is_down: bool,
) -> None:
    monkeypatch.setattr(check, "SYS_NET", place)
    monkeypatch.setattr(check, "open_device", lambda *_: GivenDevice())
    (place / "can0").mkdir()
    (place / "can0" / "flags").write_text(f"{flags:#x}\n", encoding="ascii")
    path = configured(place, source={"kind": "can", "channel": "can0"})
    assert main(["check", str(path)]) == 0
    noted = "note: source.channel: can0 is down; bring it up: ip link set can0 up type can"
    assert (noted in capsys.readouterr().out) == is_down


class TestStatus:
    @pytest.fixture(autouse=True)
    def _impatient(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(client, "TIMEOUT_S", 0.1)
        monkeypatch.setattr(getpass, "getuser", lambda: "robin")

    @pytest.mark.parametrize("what", ["socket", "directory"])
    @pytest.mark.usefixtures("line")
    def test_no_permission_is_not_no_daemon(
        self, place: Path, request: pytest.FixtureRequest, what: str
    ) -> None:
        at = place / "run"
        at.mkdir()
        with socket.socket(socket.AF_UNIX) as other:
            other.bind(f"{at}/control")
            other.listen()
            closed = at / "control" if what == "socket" else at
            closed.chmod(0)
            request.getfixturevalue("plain_user")
            told = refused("status", "--endpoint", f"ipc://{at}/control", status=1)
            at.chmod(0o755)
        assert told.startswith(f"no permission to ask at ipc://{at}/control: it is for members of ")
        assert told.endswith(" robin, then log in again\n")

    def test_who_is_not_in_the_group_is_told_of_the_services_daemon(
        self, place: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        service, own = place / "taxeld", place / "own"
        service.mkdir()
        own.mkdir()
        service.chmod(0)
        monkeypatch.setattr(endpoints, "RUNTIME", service)
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(own))
        request.getfixturevalue("plain_user")
        endpoint = f"ipc://{own}/taxeld/control"
        told = refused("status", "--endpoint", endpoint, status=1)
        assert told.startswith(f"no daemon answers at {endpoint}; is 'taxeld run' there? That of ")
        assert f"That of the service, in {service}, is for members of the group " in told
        assert told.endswith(" robin, then log in again\n")
        service.chmod(0o755)

    def test_what_takes_the_question_and_is_no_daemon_is_told(self, place: Path) -> None:
        with socket.socket(socket.AF_UNIX) as other:
            other.bind(f"{place}/control")
            other.listen()
            told = refused("status", "--endpoint", f"ipc://{place}/control", status=1)
        assert "takes the question and does not answer" in told


def test_a_robot_that_publishes_though_no_endpoint_is_set_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = f"ipc://{tmp_path}/poses"
    monkeypatch.setattr(check, "POSES_USUAL", usual)
    monkeypatch.setattr(check, "HEAR_POSES_S", 30.0)
    done = threading.Event()

    def publish() -> None:
        with zmq.Context() as context, context.socket(zmq.PUB) as robot:
            robot.setsockopt(zmq.LINGER, 0)
            robot.bind(usual)
            while not done.wait(0.02):
                robot.send_multipart([b"/robot/sensor_pose", b"", b""])

    robot = threading.Thread(target=publish)
    robot.start()
    try:
        noted = printed("check", configured(tmp_path, source=QUIET)).splitlines()[1:]
        heard = {"endpoint": usual}
        silent = printed("check", configured(tmp_path, source=QUIET, sensor_pose=heard))
    finally:
        done.set()
        robot.join()
    assert [line.startswith("note: sensor_pose.endpoint: is empty") for line in noted] == [True]
    assert silent.count("\n") == 1
