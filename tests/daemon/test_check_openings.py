"""`taxeld check` opens what `taxeld run` opens, and names each fault; and why no daemon answers."""

import contextlib
import ctypes
import errno
import fcntl
import getpass
import os
import pty
import select
import socket
import termios
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import can
import pytest

from taxeld.cli import main
from taxeld.commands import check
from taxeld.config import endpoints
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.source.opening import open_device
from taxeld.source.sources import LiveSource
from taxeld.stream import client
from tests.rig.commands import printed, refused
from tests.rig.configurations import QUIET, Table, configuration
from tests.rig.given_device import GivenDevice
from tests.rig.skins import SKIN

NAMES = {"publish": "publish.endpoints", "control": "control.endpoint"}
CAPABILITIES = 0x20080522  # version 3 of the kernel's interface
MAY_ALL = 0b110  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 0.1)


@pytest.fixture
def plain_user() -> Iterator[None]:
    """Root is forbidden what others are: modes hold for this thread."""
    libc, header = ctypes.CDLL(None), (ctypes.c_uint32 * 2)(CAPABILITIES, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable: lower, then upper half
    libc.capget(header, sets)
    before, sets[0] = sets[0], sets[0] & ~MAY_ALL
    assert libc.capset(header, sets) == 0
    yield
    sets[0] = before
    assert libc.capset(header, sets) == 0


@pytest.fixture
def ends() -> Iterator[tuple[int, Path]]:
    """The far end of a serial line, and the line's device."""
    far, near = pty.openpty()
    tty.setraw(near)
    yield far, Path(os.ttyname(near))
    os.close(far)
    os.close(near)


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From now on a daemon answers."""
    return lambda: monkeypatch.setattr(client, "ask", lambda *_: {"ok": True})


def configured(tmp_path: Path, **tables: Table) -> Path:
    """A daemon that serves nobody, and has no object, as that opens slowly."""
    nobody: dict[str, Table] = {"publish": {"endpoints": []}, "control": {"endpoint": ""}}
    return configuration(tmp_path, **{"scene": {}, **nobody, **tables})


SPEED = "source.channel: {} must end with @ and a line speed, as /dev/null@115200"
SOCKET = "taxeld.source.socketcan.socket.socket"
SERIAL, SLCAN, PCAN = {"kind": "serial"}, {"interface": "slcan"}, {"interface": "pcan"}
UNOPENED = [  # source, what fails how, and the beginning of the line
    ({"interface": "PCAN"}, {}, "source.interface: python-can knows no 'PCAN'; did you mean pc"),
    ({"interface": "/dev/tty"}, {}, "source.interface: python-can knows no '/dev/tty'; it knows "),
    (
        PCAN,
        {"can.Bus": Mock(side_effect=OSError("pcanbasic library not found."))},
        "source.interface: python-can cannot use pcan (pcanbasic library not found.); is its maker",
    ),
    (
        {"channel": "/dev/ttyACM7"},
        {},
        "source.channel: /dev/ttyACM7 is no name of a CAN interface, as can0 is; for an SLCAN "
        'adapter set source.interface = "slcan"',
    ),
    (SLCAN | {"channel": "/dev/null"}, {}, "source.channel: cannot open /dev/null (it is no se"),
    *((SLCAN | {"channel": s}, {}, SPEED.format(s)) for s in ("/dev/null@", "/dev/null@300")),
    (SERIAL | {"channel": "{place}"}, {}, "source.channel: cannot open {place} (it is a director"),
    (
        SERIAL | {"channel": "{line}"},
        {},
        "source.channel: cannot open {line} (permission denied; is this user in the group",
    ),
]
AWAY = [  # the same, of a device for which a run waits
    (
        PCAN,
        {"can.Bus": Mock(side_effect=can.CanInitializationError("The value of a handle"))},
        "source.channel: cannot open pcan x (The value of a handle)",
    ),
    (
        {"channel": "can0"},
        {SOCKET: Mock(side_effect=OSError(errno.EAFNOSUPPORT, "Address family"))},
        "source.channel: cannot open socketcan can0 (this kernel has no CAN: 'modprobe -a can "
        'can_raw\' loads it, and an SLCAN adapter, source.interface = "slcan", does without)',
    ),
    (
        {"channel": "can77"},
        {SOCKET: Mock(**{"return_value.bind.side_effect": OSError(errno.ENODEV, "")})},
        "source.channel: no CAN interface 'can77'; bring it up: ip link set can77 up type can ",
    ),
    (
        SERIAL | {"channel": "/dev/ttyACM77"},
        {},
        "source.channel: cannot open /dev/ttyACM77 (it is not there; is it plugged in?)",
    ),
    (  # a driver's complaint is no OSError
        SERIAL | {"channel": "{line}"},
        {"termios.tcsetattr": Mock(side_effect=termios.error(errno.EIO, "Input/output error"))},
        "source.channel: cannot open {line} (Input/output error)",
    ),
]


@pytest.mark.parametrize(
    ("source", "fails", "begin", "waits"),
    [*((*row, False) for row in UNOPENED), *((*row, True) for row in AWAY)],
    ids=[begin[:60] for *_, begin in (*UNOPENED, *AWAY)],
)
@pytest.mark.usefixtures("plain_user")
def test_check_says_what_run_says_of_a_device_that_does_not_open(
    tmp_path: Path,
    ends: tuple[int, Path],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    source: Table,
    fails: dict[str, Mock],
    begin: str,
    waits: bool,
) -> None:
    line = ends[1]
    line.chmod(0 if "permission" in begin else 0o600)
    channel = source.get("channel", "x").format(place=tmp_path, line=line)
    path = configured(tmp_path, source={"kind": "can", **source, "channel": channel})
    for target, failing in fails.items():
        monkeypatch.setattr(target, failing)
    told = refused("check", path).rstrip()
    assert told.startswith(begin.format(place=tmp_path, line=line))
    try:
        LiveSource(load(path).source, {0: SKIN}, open_device, wait=True).close()
        said = caplog.messages
    except SetupError as error:
        said = [str(error)]
    assert said == [f"{told}; waiting for it" if waits else told]


@pytest.mark.parametrize("kind", [SERIAL, {"kind": "can", **SLCAN}], ids=["serial", "slcan"])
def test_a_device_is_opened_for_this_process_alone_and_nothing_is_sent_to_it(
    tmp_path: Path, ends: tuple[int, Path], kind: Table, answering: Callable[[], None]
) -> None:
    """Unless the other process is a daemon that answers. The locks of two open files of one process
    keep each other out as those of two do."""
    far, line = ends
    control = {"endpoint": f"ipc://{tmp_path}/control"}
    path = configured(tmp_path, source={**kind, "channel": line}, control=control)
    cure = f"another process has it open; stop that first, 'fuser {line}' tells which"
    with line.open("rb", buffering=0) as held:
        printed("check", path)  # who only has it open keeps nobody out
        assert select.select([far], [], [], 0)[0] == []
        fcntl.flock(held, fcntl.LOCK_EX)
        assert cure in refused("check", path)
        source = LiveSource(load(path).source, {0: SKIN}, open_device, wait=True)
        with contextlib.closing(source) as waiting:
            assert cure in waiting.waits_for
        answering()
        printed("check", path)


def test_more_scans_than_the_bus_carries_are_refused_with_the_period_that_it_does(
    tmp_path: Path,
) -> None:
    source = {**QUIET, "bitrate": 10_000, "period_ms": 266}
    assert refused("check", configured(tmp_path, source=source)) == (
        "source.period_ms: 8 modules every 266 ms are 86 frames/s, and a bus of 10000 bit/s "
        "carries 86: at least 267 ms\n"
    )
    printed("check", configured(tmp_path, source=source | {"period_ms": 267}))


def listening(at: Path) -> socket.socket:
    other = socket.socket(socket.AF_UNIX)
    other.bind(str(at))
    other.listen()
    return other


@pytest.mark.parametrize("key", ["publish", "control"])
@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda at: listening(at).close(), ""),  # left by a daemon that was killed
        (listening, "another daemon serves {at}"),
        (Path.touch, "{at} is no socket; remove it"),
        (lambda at: at.parent.rmdir(), "does not exist; the service makes it"),
        (
            lambda at: at.parent.chmod(0o555),
            "cannot bind ipc://{at} (Permission denied); is another daemon there?",
        ),
    ],
    ids=["left", "served", "no socket", "no directory", "closed"],
)
@pytest.mark.usefixtures("plain_user")
def test_an_endpoint_that_cannot_be_had_is_refused(
    tmp_path: Path,
    answering: Callable[[], None],
    key: str,
    made: Callable[[Path], socket.socket | None],
    words: str,
) -> None:
    """One that is served is none, if a daemon answers."""
    at = tmp_path / "run" / "s"
    at.parent.mkdir()
    with made(at) or contextlib.nullcontext():
        served: dict[str, Table] = {
            "publish": {"endpoints": [f"ipc://{at}"] if key == "publish" else []},
            "control": {"endpoint": f"ipc://{at if key == 'control' else tmp_path / 'control'}"},
        }
        path = configured(tmp_path, source=QUIET, **served)
        told = refused("check", path) if words else f"{NAMES[key]}: {printed('check', path)}"
        assert told.startswith(f"{NAMES[key]}: ")
        assert words.format(at=at) in told
        answering()
        assert main(["check", str(path)]) == (2 if words and made is not listening else 0)


@pytest.mark.parametrize(("flags", "is_down"), [(0x40C0, True), (0x40C1, False)])
def test_an_interface_that_is_down_is_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: int, is_down: bool
) -> None:
    monkeypatch.setattr(check, "SYS_NET", tmp_path)
    monkeypatch.setattr(check, "open_device", lambda *_: GivenDevice())
    (tmp_path / "can0").mkdir()
    (tmp_path / "can0" / "flags").write_text(f"{flags:#x}\n", encoding="ascii")
    said = printed("check", configured(tmp_path, source={"kind": "can", "channel": "can0"}))
    noted = "note: source.channel: can0 is down; bring it up: ip link set can0 up type can"
    assert (noted in said) == is_down


@pytest.mark.parametrize(
    ("closed", "group", "told"),
    [
        ("control", "taxeld", "for members of the group taxeld: sudo usermod -aG taxeld "),
        ("", "taxeld", "for members of the group taxeld: sudo usermod -aG taxeld robin, "),
        ("", "rob3", "open to rob3 alone: ask as rob3, or run the daemon as the service"),
        ("../other", "", "something at ipc://{at}/control takes the question and does not answer"),
    ],
)
@pytest.mark.usefixtures("plain_user")
def test_no_permission_or_another_program_is_not_no_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, closed: str, group: str, told: str
) -> None:
    at = tmp_path / "run"
    for directory in (at, tmp_path / "other"):
        directory.mkdir()
    monkeypatch.setattr(getpass, "getuser", lambda: "robin")
    monkeypatch.setattr(Path, "group", lambda _: group)
    monkeypatch.setattr(Path, "owner", lambda _: "rob3")
    with listening(at / "control"):
        (at / closed).chmod(0)
        said = refused("status", f"ipc://{at}/control", status=1)
    no_permission = f"no permission to ask at ipc://{at}/control: it is " * bool(group)
    assert said.startswith(no_permission + told.format(at=at))


@pytest.mark.usefixtures("plain_user")
def test_who_is_not_in_the_group_is_told_of_the_services_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for directory, mode in (("taxeld", 0), ("own", 0o700)):
        (tmp_path / directory).mkdir(mode=mode)
    monkeypatch.setattr(endpoints, "RUNTIME", tmp_path / "taxeld")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "own"))
    endpoint = f"ipc://{tmp_path}/own/taxeld/control"
    told = refused("status", endpoint, status=1)
    assert told.startswith(f"no daemon answers at {endpoint}; is 'taxeld run' there? That of the ")
    assert f"That of the service, in {tmp_path}/taxeld, is " in told
