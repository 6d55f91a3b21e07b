"""The virtual hub answers as the wire's facts say; and the table of commands."""

import pytest

from taxeld_protocol import commands, cyskin
from taxeld_protocol.cyskin import LEAVE_BOOTLOADER, Command, ErrorCode, Packet
from taxeld_protocol.frames import parse_log_line
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import HubLink, Phase, VirtualIhb

UIDS = [0x11, 0x12, 0x21]


def hub(phase: Phase = Phase.RUNNING) -> VirtualIhb:
    return VirtualIhb(wired(UIDS), uid=0xC0FFEE01, short_id=3, phase=phase)


def ask(
    ihb: VirtualIhb, command: int, payload: bytes = b"", to: int = 0xFF
) -> list[tuple[int, bytes]]:
    return ihb.answer(Packet(0.0, to, command, payload))


def test_a_hub_hears_the_frame_that_ends_its_bootloader_and_no_other_of_29_bits() -> None:
    def heard(line: str) -> Packet | None:
        frame = parse_log_line(line)
        assert frame is not None
        return HubLink().feed(frame)

    leave = Packet(0.0, 0xFF, LEAVE_BOOTLOADER, b"")
    assert heard("17FFFFFF#013B00004F6D17") == leave
    assert heard("17FFFFFF#013B00004F6D16") is None
    assert heard("17FFFFFE#013B00004F6D17") is None
    assert heard("7FF#013B00004F6D17") is None
    assert [HubLink().feed(f) for f in cyskin.to_frames(LEAVE_BOOTLOADER, ihb=0xFF)] == [leave]
    assert heard("5FF#3C00D2") == Packet(0.0, 0xFF, Command.DECLARE, b"")


def test_auto_sync_sends_scans_at_the_period_and_stops() -> None:
    ihb = hub()
    assert not ihb.due(0.0)
    ask(ihb, Command.SET_AUTO_SYNC_PERIOD, b"\x00\x14")
    ask(ihb, Command.SET_AUTO_SYNC, b"\x01")
    sent = [ms for ms in range(100) if ihb.due(ms / 1000)]
    assert sent == [0, 20, 40, 60, 80]
    ask(ihb, Command.SET_AUTO_SYNC, b"\x00")
    assert not any(ihb.due(ms / 1000) for ms in range(100, 200))


def test_a_late_caller_skips_scans_and_keeps_the_beat() -> None:
    ihb = hub()
    ask(ihb, Command.SET_AUTO_SYNC, b"\x01")
    assert [t for t in (0.0, 0.27, 0.28, 0.3, 0.34, 0.351) if ihb.due(t)] == [0.0, 0.27, 0.3, 0.351]


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
    command: int, payload: bytes, code: ErrorCode
) -> None:
    assert ask(hub(), command, payload) == [(Command.ERROR, bytes((command, code)))]


def test_a_reboot_forgets_what_the_host_set() -> None:
    ihb = hub()
    ask(ihb, Command.SET_AUTO_SYNC, b"\x01")
    ask(ihb, Command.MODULE_SET_CUT_SENSORS, b"\xff\x00\x01")
    ask(ihb, Command.IHB_COLD_REBOOT)
    assert not ihb.auto_sync
    assert ihb.modules == hub().modules


@pytest.mark.parametrize("table", [commands.REQUESTS, commands.ANSWERS])
def test_the_table_round_trips(table: commands.Table) -> None:
    encode, decode = (
        (commands.request, commands.parse_request)
        if table is commands.REQUESTS
        else (commands.answer, commands.parse_answer)
    )
    for command, (_, names) in table.items():
        fields = {name: i + 1 for i, name in enumerate(names)}
        payload = encode(command, **fields)
        assert decode(command, payload) == fields
        assert decode(command, payload + b"\0") is None
        assert decode(command, payload[:-1]) is None
