"""`taxeld check` opens what `taxeld run` opens, and names each fault; and why no daemon answers."""

import contextlib
import ctypes
import errno
import fcntl
import getpass
import grp
import os
import pty
import pwd
import re
import socket
import tempfile
import threading
import tty
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import can
import pytest
import zmq

from taxeld.cli import main
from taxeld.commands import check
from taxeld.config import endpoints
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.source import socketcan_device
from taxeld.source.device import AwayError
from taxeld.source.sources import open_source
from taxeld.stream import client, messages
from tests.rig.commands import printed, refused
from tests.rig.configurations import QUIET, Table, configuration
from tests.rig.given_device import GivenDevice
from tests.rig.skins import SKIN

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


@dataclass
class Opening:
    """A device that does not open, and what `check` and `run` say of it."""

    source: Table
    line: str
    error: Exception | None = None  # of python-can, or of the kernel's sockets
    waits: bool = False  # whether `run` waits for the device, as it may come


NO_LIBRARY = "is its maker's library installed, and source.channel one of its own?"
UNOPENED = {
    "unknown interface": Opening(
        {"interface": "pcna", "channel": "x"},
        "source.interface: python-can knows no 'pcna'; did you mean pcan?",
    ),
    "interface in capitals": Opening(
        {"interface": "PCAN", "channel": "x"},
        "source.interface: python-can knows no 'PCAN'; did you mean pcan?",
    ),
    "no interface of any name": Opening(
        {"interface": "/dev/ttyACM0", "channel": "x"},
        "source.interface: python-can knows no '/dev/ttyACM0'; it knows canalystii, cantact, ",
    ),
    "no library": Opening(
        {"interface": "pcan", "channel": "PCAN_USBBUS1"},
        "source.interface: python-can cannot use pcan (pcanbasic library not found.); "
        + NO_LIBRARY,
        OSError("pcanbasic library not found."),
    ),
    "no library, and no word of it": Opening(
        {"interface": "kvaser", "channel": "0"},
        "source.interface: python-can cannot use kvaser (name 'canGetNumberOfChannels' is not "
        "defined); " + NO_LIBRARY,
        NameError("name 'canGetNumberOfChannels' is not defined"),
    ),
    "no package": Opening(
        {"interface": "gs_usb", "channel": "0"},
        "source.interface: python-can cannot use gs_usb (No module named 'usb'); " + NO_LIBRARY,
        can.CanInterfaceNotImplementedError("No module named 'usb'"),
    ),
    "arguments that python-can lacks": Opening(
        {"interface": "socketcand", "channel": "can0"},
        "source.interface: python-can cannot use socketcand (missing 'host' and 'port'); ",
        TypeError("missing 'host' and 'port'"),
    ),
    "adapter not plugged in": Opening(
        {"interface": "pcan", "channel": "PCAN_USBBUS1"},
        "source.channel: cannot open pcan PCAN_USBBUS1 (The value of a handle is invalid)",
        can.CanInitializationError("The value of a handle is invalid"),
        waits=True,
    ),
    "unknown host": Opening(
        {"interface": "udp_multicast", "channel": "x"},
        "source.channel: cannot open udp_multicast x ([Errno -2] Name or service not known)",
        socket.gaierror(-2, "Name or service not known"),
        waits=True,
    ),
    "serial line as an interface": Opening(
        {"channel": "/dev/ttyACM7"},
        "source.channel: /dev/ttyACM7 is no name of a CAN interface, as can0 is; for an SLCAN "
        'adapter set source.interface = "slcan"',
    ),
    "interface with a long name": Opening(
        {"channel": "an_interface_name"},
        "source.channel: an_interface_name is no name of a CAN interface, as can0 is",
    ),
    "kernel without CAN": Opening(
        {"channel": "can0"},
        "source.channel: cannot open socketcan can0 (this kernel has no CAN: 'modprobe -a can "
        'can_raw\' loads it, and an SLCAN adapter, source.interface = "slcan", does without)',
        OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol"),
        waits=True,
    ),
    "no serial line": Opening(
        {"kind": "serial", "channel": "/dev/null"},
        "source.channel: cannot open /dev/null (it is no serial line)",
    ),
    "no serial line for SLCAN": Opening(
        {"interface": "slcan", "channel": "/dev/null"},
        "source.channel: cannot open /dev/null (it is no serial line)",
    ),
    "serial line not plugged in": Opening(
        {"kind": "serial", "channel": "/dev/ttyACM77"},
        "source.channel: cannot open /dev/ttyACM77 (it is not there; is it plugged in?)",
        waits=True,
    ),
}


@pytest.mark.parametrize("opening", UNOPENED.values(), ids=UNOPENED)
def test_check_says_what_run_says_of_a_device_that_does_not_open(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    opening: Opening,
) -> None:
    def fail(*_: object, **__: object) -> None:
        assert opening.error is not None
        raise opening.error

    path = configured(place, source={"kind": "can", **opening.source})
    if opening.error is not None:
        monkeypatch.setattr(can, "Bus", fail)
        monkeypatch.setattr(socketcan_device.socket, "socket", fail)
    told = refused("check", path).rstrip()
    assert told.startswith(opening.line)
    if opening.waits:
        with contextlib.closing(open_source(load(path).source, SKIN, wait=True)):
            assert caplog.messages == [f"{told}; waiting for it"]
    else:
        with pytest.raises(SetupError, match=f"^{re.escape(told)}$") as caught:
            open_source(load(path).source, SKIN, wait=True)
        assert not isinstance(caught.value, AwayError)


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


def test_more_scans_than_the_bus_carries_are_refused_with_the_period_that_it_does(
    place: Path,
) -> None:
    source = {**QUIET, "bitrate": 10_000, "period_ms": 266}
    assert refused("check", str(configured(place, source=source))) == (
        "source.period_ms: 8 modules every 266 ms are 86 frames/s, and a bus of 10000 bit/s "
        "carries 86: at least 267 ms\n"
    )
    assert main(["check", str(configured(place, source=source | {"period_ms": 267}))]) == 0


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
        assert told.startswith(f"no permission to ask at ipc://{at}/control: it is ")

    @pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a directory away")
    @pytest.mark.parametrize(
        ("group", "cure"),
        [
            ("taxeld", "it is for members of the group taxeld: sudo usermod -aG taxeld robin, "),
            ("root", "it is open to root and its group alone: ask as root, or run the daemon as "),
            ("wheel", "it is open to root and its group alone: ask as root, or run the daemon as "),
            ("rob3", "it is open to rob3 and its group alone: ask as rob3, or run the daemon as "),
        ],
    )
    def test_nobody_is_told_to_join_the_own_group_of_root_or_of_a_person(
        self,
        place: Path,
        request: pytest.FixtureRequest,
        monkeypatch: pytest.MonkeyPatch,
        group: str,
        cure: str,
    ) -> None:
        at = place / "run"
        at.mkdir()
        number = {"root": 0, "wheel": 0, "taxeld": 998, "rob3": 1003}[group]
        os.chown(at, 0, number)
        users = {"root": (0, 0), "taxeld": (998, 998), "rob3": (1003, 1003)}

        def user(name: str) -> SimpleNamespace:
            return SimpleNamespace(pw_uid=users[name][0], pw_gid=users[name][1])

        monkeypatch.setattr(pwd, "getpwnam", user)
        monkeypatch.setattr(grp, "getgrgid", lambda _: SimpleNamespace(gr_name=group))
        at.chmod(0)
        request.getfixturevalue("plain_user")
        told = refused("status", "--endpoint", f"ipc://{at}/control", status=1)
        at.chmod(0o755)
        assert told.startswith(f"no permission to ask at ipc://{at}/control: {cure}")

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
        assert f"That of the service, in {service}, is " in told
        service.chmod(0o755)

    def test_a_daemons_stream_is_not_its_control_endpoint(self, place: Path) -> None:
        done, stream = threading.Event(), f"ipc://{place}/stream"

        def publish() -> None:
            with zmq.Context() as context, context.socket(zmq.XPUB) as daemon:
                daemon.setsockopt(zmq.LINGER, 0)
                daemon.bind(stream)
                while not done.wait(0.02):
                    daemon.send_multipart([messages.ESTIMATE, b"", b""])

        daemon = threading.Thread(target=publish)
        daemon.start()
        try:
            told = refused("status", "--endpoint", stream, status=1)
        finally:
            done.set()
            daemon.join()
        assert told.startswith(f"{stream} is where a daemon publishes; name its control endpoint, ")

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
