"""The skin's end of a transport: its device's name, and its listeners, who come and go."""

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from taxeld.stream.topics import SENSOR_POSE
from taxeld_hil.cli import main
from taxeld_hil.rig.ports import ArrayPort, Feed, NativePort
from taxeld_hil.rig.rig import Rig
from taxeld_hil.rig.virtual_ihb import HubLink, Phase, VirtualIhb
from taxeld_hil.scenario import scenario
from taxeld_protocol import array, cyskin
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, ErrorCode, Packet
from taxeld_protocol.frames import parse_log_line
from taxeld_protocol.modules import wired
from tests.rig.clocks import PATIENCE_S
from tests.rig.commands import refuses
from tests.rig.sockets import Sockets

PATIENCE_MS = int(1e3 * PATIENCE_S)


@pytest.fixture
def sockets() -> Iterator[Sockets]:
    with Sockets() as made:
        yield made


def test_a_topic_is_heard_until_the_last_of_those_leaves_whose_prefixes_have_it(
    sockets: Sockets, tmp_path: Path
) -> None:
    endpoint = f"ipc://{tmp_path}/poses"
    with Feed(endpoint, "--poses") as feed:

        def is_heard() -> bool:
            assert feed.socket.poll(PATIENCE_MS), "nobody has come or left"
            return feed.is_heard(SENSOR_POSE)

        stays = sockets.subscriber(endpoint, SENSOR_POSE)
        assert is_heard()
        for option in (zmq.SUBSCRIBE, zmq.UNSUBSCRIBE):  # as a daemon that looks for other topics
            stays.setsockopt(option, b"")
            assert is_heard()
        other = sockets.subscriber(endpoint, b"/robot")
        assert is_heard()
        for option in (zmq.UNSUBSCRIBE, zmq.SUBSCRIBE):
            other.setsockopt(option, b"/robot")
            assert is_heard()
        other.close()
        assert is_heard()
        stays.close()
        assert not is_heard()
        sockets.subscriber(endpoint, SENSOR_POSE)
        assert is_heard(), "one that connects anew"


def test_arrays_come_from_the_first_listener_on_until_the_last_has_left(
    sockets: Sockets, tmp_path: Path
) -> None:
    rig, port = Rig(scenario.load("array"), 0), ArrayPort(tmp_path / "skin")
    frame, endpoint = ArrayFrame(5.0, "skin", 0, (10_000, 0, 10_002)), f"ipc://{tmp_path}/skin"

    def requests() -> int:
        assert port.feed.socket.poll(PATIENCE_MS)
        asked = port.take(0.0)
        for packet in asked:
            rig.answer(packet, 0.0)
        return len(asked)

    host = sockets.subscriber(endpoint)
    assert requests() == 1
    assert rig.hub.auto_sync, "the skin is started"
    assert port.send(frame)
    assert array.parse(array.read_json(host.recv())) == frame
    other = sockets.subscriber(endpoint, b"/skin")
    assert requests() == 0
    other.close()
    assert requests() == 0
    assert port.is_open
    host.close()
    assert requests() == 1
    assert not port.is_open
    assert not rig.hub.auto_sync
    port.close()


def test_the_link_that_a_killed_emulator_left_is_replaced_and_a_living_ones_left_alone(
    tmp_path: Path,
) -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    link = tmp_path / "skin"
    link.symlink_to("/dev/pts/999999")
    port = NativePort(link)
    assert link.is_char_device()
    before, opened = link.readlink(), open_files()
    refuses(r"skin: cannot be made \(another skin is there; stop it", NativePort, link)
    assert link.readlink() == before
    assert open_files() == opened, "no pseudo-terminal is left open"
    port.close()
    assert not link.is_symlink()


@pytest.mark.parametrize(("name", "why"), [("no/skin", "No such file"), ("file", "File exists")])
def test_a_link_that_cannot_be_made_is_one_line(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "file").touch()
    refuses(rf"{name}: cannot be made \({why}", NativePort, tmp_path / name)


MODULES = wired([0x11, 0x12, 0x21])
LEAVE, ASK = (Packet(0.0, BROADCAST, c, b"") for c in (LEAVE_BOOTLOADER, Command.DECLARE))


@pytest.fixture
def hub() -> VirtualIhb:
    return VirtualIhb(MODULES, uid=0xC0FFEE01, short_id=3, phase=Phase.RUNNING)


def ask(hub: VirtualIhb, command: int, payload: bytes = b"") -> list[tuple[int, bytes]]:
    return hub.answer(Packet(0.0, BROADCAST, command, payload))


@pytest.mark.parametrize(
    ("line", "heard"),
    [
        ("17FFFFFF#013B00004F6D17", LEAVE),
        ("17FFFFFF#013B00004F6D16", None),
        ("17FFFFFE#013B00004F6D17", None),
        ("7FF#013B00004F6D17", None),
        ("5FF#3C00D2", ASK),
    ],
)
def test_a_hub_hears_the_frame_that_ends_its_bootloader_and_no_other_of_29_bits(
    line: str, heard: Packet | None
) -> None:
    frame = parse_log_line(line)
    assert HubLink().feed(frame) == heard
    if heard is not None:
        assert cyskin.to_frames(heard.command, ihb=BROADCAST) == [frame]


@pytest.mark.parametrize(
    ("asked", "sent"),
    [
        ([*range(100)], [0, 20, 40, 60, 80]),
        ([0, 107, 108, 120, 136, 141], [0, 107, 120, 141]),
    ],
    ids=["at its period", "a late caller skips scans and keeps the beat"],
)
def test_auto_sync_sends_scans_and_stops(
    hub: VirtualIhb, asked: list[int], sent: list[int]
) -> None:
    assert not hub.due(0.0)
    ask(hub, Command.SET_AUTO_SYNC_PERIOD, b"\x00\x14")
    ask(hub, Command.SET_AUTO_SYNC, b"\x01")
    assert [ms for ms in asked if hub.due(ms / 1000)] == sent
    ask(hub, Command.SET_AUTO_SYNC, b"\x00")
    assert not any(hub.due(ms / 1000) for ms in range(200, 300))


@pytest.mark.parametrize(
    ("command", "payload", "code"),
    [
        (0x99, b"", ErrorCode.NOT_SUPPORTED),
        (Command.SET_COMM_SPEED, b"\4", ErrorCode.NOT_SUPPORTED),
        (Command.MODULE_SET_CUT_SENSORS, b"\7\0\0", ErrorCode.INVALID),
        (Command.MODULE_SET_CUT_SENSORS, b"\0\xff\xff", ErrorCode.INVALID),
        (Command.SET_AUTO_SYNC, b"", ErrorCode.FORMAT),
        (Command.SET_AUTO_SYNC_PERIOD, b"\0", ErrorCode.FORMAT),
        (Command.SET_AUTO_SYNC_PERIOD, b"\0\0", ErrorCode.INVALID),
        (Command.MODULE_DETAILS, b"", ErrorCode.FORMAT),
        (Command.MODULE_DETAILS, b"\x09", ErrorCode.INVALID),
        (Command.DISCOVERY_RECV_ID, b"\x01", ErrorCode.FORMAT),
    ],
)
def test_what_it_cannot_do_is_an_error_naming_the_command(
    hub: VirtualIhb, command: int, payload: bytes, code: ErrorCode
) -> None:
    assert ask(hub, command, payload) == [(Command.ERROR, bytes((command, code)))]


NO_FOAM = "no foam 'marble'; there are scene, typical, poor, stiff; a layout is given by --layout\n"
NO_BUNDLE = "scene.bundle: no bundle 'party'"
NO_ENDPOINT = "; use ipc:///path or tcp://"
EMULATE = "emulate demo --link {place}/skin --out {place}/out --poses"

WRONG = [  # a command line, and words of its line
    ("run demo --random 0", "--random: must be 1..120 minutes"),
    ("grade {place}/none", "none: is no session"),
    ("run demo --foam marble", NO_FOAM),
    ("run demo --clock fake --object party", NO_BUNDLE),
    ("run demo --advised", "advised: such a robot runs on the fake clock alone: --clock fake\n"),
    ("emulate links --can vcan0 --poses ipc:///x --out {place}/out", "layouts: several links run"),
    ("run party", "no scenario 'party'; shipped are "),
    ("matrix demo --foam marble --out {place}/out", NO_FOAM),
    ("matrix demo --seeds 0 --out {place}/out", "--seeds must be at least 1"),
    ("matrix demo --workers 0 --out {place}/out", "--workers must be at least 1"),
    (f"{EMULATE} foo", "--poses: 'foo' "),
    (f"{EMULATE} tcp://", NO_ENDPOINT),
    (f"{EMULATE} tcp://127.0.0.1:99999", NO_ENDPOINT),
    ("accept {place}", "{place}: is no session (it has no config.toml)"),
]


@pytest.mark.parametrize(("line", "expected"), WRONG)
def test_a_wrong_command_line_is_refused_with_one_line_and_leaves_nothing(
    line: str, expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("{}", encoding="utf-8")
    assert main([word.format(place=tmp_path) for word in shlex.split(line)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert expected.format(place=tmp_path) in error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_run_leaves_a_configuration_that_is_there_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "config.toml"
    mine.write_text("mine", encoding="utf-8")
    assert main(["run", "demo", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"--out: {mine} is there already; name another directory\n"
    assert mine.read_text(encoding="utf-8") == "mine"
