"""The protocol, for `make bench`: CPU time of the decoder, and a saturated bus."""

import random
import statistics
import time

import can

from taxeld.config.tables import SourceConfig
from taxeld.layout import read as layouts
from taxeld.source.opening import open_source
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

SATURATED_FRAMES_S = 9_000  # most frames of 8 bytes on a bus of 1 Mbit/s
ROUNDS = 7
MODULES = wired([(i // 10 + 1) << 4 | (i % 10 + 1) for i in range(600)])
CHANNELS = sum(module.channels for module in MODULES)


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
    spent = []
    for _ in range(ROUNDS):
        decoder, start = Decoder(lambda _: MODULES), time.process_time()
        assert sum(len(decoder.feed(frame)[1]) for frame in frames) == 60
        spent.append(time.process_time() - start)
    rate = len(frames) / statistics.median(spent)
    return [("fragments to scans, frames/s (at least)", rate, 10.0 * SATURATED_FRAMES_S)]


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
