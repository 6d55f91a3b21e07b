"""The protocol, for `make bench`: CPU time of three decoders, interleaved, and a saturated bus."""

import random
import statistics
import time
from collections.abc import Callable

import can
import cantools

from taxeld.config.tables import SourceConfig
from taxeld.layout import read as layouts
from taxeld.source.sources import open_source
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

SATURATED_FRAMES_S = 9_000  # most frames of 8 bytes on a bus of 1 Mbit/s
ROUNDS = 7
MODULES = wired([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(600)])
CHANNELS = sum(module.channels for module in MODULES)

DBC = """VERSION ""
BU_: IHB
BO_ 257 SCAN: 8 IHB
 SG_ A : 7|16@0+ (1,0) [0|65535] "" IHB
 SG_ B : 23|16@0+ (1,0) [0|65535] "" IHB
 SG_ C : 39|16@0+ (1,0) [0|65535] "" IHB
 SG_ D : 55|16@0+ (1,0) [0|65535] "" IHB
"""


def rows() -> list[tuple[str, float, float | None]]:
    """(figure, measured, budget) of everything here."""
    return [*throughput(), *saturated()]


def scan_frames(scans: int, seed: int = 0) -> list[Frame]:
    """A hub of 60 modules, scan after scan, 20 a second."""
    rng = random.Random(seed)
    hub = VirtualIhb(MODULES)
    return [
        frame
        for k in range(scans)
        for command, payload in hub.sensor_data([rng.randint(1, 42_000) for _ in range(CHANNELS)])
        for frame in cyskin.to_frames(command, payload, ihb=1, t=k * 0.05)
    ]


def throughput() -> list[tuple[str, float, float | None]]:
    frames = scan_frames(60)
    message = cantools.database.load_string(DBC, "dbc").messages[0]
    full = [frame.data for frame in frames if len(frame.data) == 8]

    def ours() -> None:
        decoder = Decoder(lambda _: MODULES)
        scans = sum(len(decoder.feed(frame)[1]) for frame in frames)
        assert scans == 60

    def plain() -> None:
        assert len(plain_decoder(frames)) == 60

    def dbc() -> None:
        for data in full:
            message.decode(data)

    spent: dict[Callable[[], None], list[float]] = {ours: [], plain: [], dbc: []}
    for _ in range(ROUNDS):
        for work, times in spent.items():
            start = time.process_time()
            work()
            times.append(time.process_time() - start)
    rate = {
        work: len(full if work is dbc else frames) / statistics.median(times)
        for work, times in spent.items()
    }
    return [
        ("fragments to scans, frames/s (at least)", rate[ours], 10.0 * SATURATED_FRAMES_S),
        ("the same by a plain per-frame decoder, frames/s", rate[plain], None),
        ("cantools decoding as many 8-byte frames, frames/s", rate[dbc], None),
        ("ours over the plain decoder", rate[ours] / rate[plain], None),
        ("ours over cantools", rate[ours] / rate[dbc], None),
    ]


def plain_decoder(frames: list[Frame]) -> list[list[int]]:
    """The simplest way to write it: bytes joined, the CRC bit by bit, a step for each value."""
    scans: list[list[int]] = []
    scan: list[int] = []
    data = b""
    for frame in frames:
        kind = frame.can_id & 0x700
        data = frame.data if kind in (0x100, 0x500) else data + frame.data
        if kind not in (0x400, 0x500) or len(data) < 3:
            continue
        crc = 0xFF
        for byte in data[: data[1] + 2]:
            crc ^= byte
            for _ in range(8):
                crc = (crc << 1 ^ 0x07) & 0xFF if crc & 0x80 else crc << 1
        if crc != data[data[1] + 2] or data[0] != cyskin.Command.SENSOR_DATA:
            continue
        module, channel = data[2], data[3]
        for at in range(4, data[1] + 2, 2):
            if (module, channel) == (0, 0) and scan:
                scans.append(scan)
                scan = []
            scan.append(data[at] << 8 | data[at + 1])
            channel += 1
            if channel == MODULES[module].channels:
                module, channel = module + 1, 0
    return [*scans, scan]


def saturated() -> list[tuple[str, float, float | None]]:
    """Ten seconds of a saturated bus through python-can, in one process."""
    skin = layouts.load("cylinder:rows=30,columns=20,radius_m=0.1,pitch_m=0.01")
    listed = tuple((module.sui or 0, module.mask) for module in MODULES)
    config = SourceConfig(
        kind="can", interface="virtual", channel="bench", listen_only=True, modules=listed
    )
    source = open_source(config, skin)
    frames = scan_frames(10 * SATURATED_FRAMES_S // 174)
    a_tick = SATURATED_FRAMES_S // 100
    scans, spent = 0, 0.0
    with can.Bus(interface="virtual", channel="bench") as bus:
        for at in range(0, len(frames), a_tick):
            for frame in frames[at : at + a_tick]:
                bus.send(
                    can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
                )
            start = time.process_time()
            scans += sum(scan.complete for scan in source.poll(at / SATURATED_FRAMES_S))
            spent += time.process_time() - start
    source.close()
    lost = len(frames) // 174 - scans
    share = 100.0 * spent / (len(frames) / SATURATED_FRAMES_S)
    return [
        ("scans lost of a saturated bus through python-can", float(lost), 0.0),
        ("CPU to read it, % of one core", share, None),
    ]
