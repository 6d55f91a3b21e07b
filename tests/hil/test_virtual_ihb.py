"""The virtual hub answers as the wire's facts say."""

import pytest

from taxeld_hil.rig.virtual_ihb import HubLink, Phase, VirtualIhb
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import BROADCAST, LEAVE_BOOTLOADER, Command, ErrorCode, Packet
from taxeld_protocol.frames import parse_log_line
from taxeld_protocol.modules import wired

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
    assert frame is not None
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


def test_a_reboot_forgets_what_the_host_set(hub: VirtualIhb) -> None:
    ask(hub, Command.SET_AUTO_SYNC, b"\x01")
    ask(hub, Command.MODULE_SET_CUT_SENSORS, b"\xff\x00\x01")
    ask(hub, Command.IHB_COLD_REBOOT)
    assert not hub.auto_sync
    assert hub.modules == MODULES
