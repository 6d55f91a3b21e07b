"""Damaged packets that pass for whole ones, with and without the rule for what follows a packet.

    python benchmarks/escapes.py [--frames N]

A hub streams random counts; of its frames 1 % are lost, 1 % come twice and 1 % change places with
the next. A packet that is delivered and was never sent has escaped the checksum. Counts alone, and
the same on every machine.
"""

import argparse
import random
from collections.abc import Iterator, Sequence
from unittest import mock

from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import FRAGMENT_BYTES, MAX_FRAGMENTS, Reassembler
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module, listed
from taxeld_protocol.virtual_ihb import VirtualIhb

FRAMES = 1_000_000
SHARE = 0.01  # of each kind of damage
PATCHES = (8, 60)  # modules: of the shipped skin, and of a large patch
WITHOUT = MAX_FRAGMENTS * FRAGMENT_BYTES  # bytes that may then follow a packet

Rows = list[tuple[str, float, float | None]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES, help="of each patch")
    for figure, measured, _ in rows(parser.parse_args().frames):
        print(f"{figure:52s} {measured:12.0f}")
    return 0


def rows(frames: int = FRAMES) -> Rows:
    """(figure, measured, no budget)."""
    found: Rows = []
    for number in PATCHES:
        modules = listed((sui, 0xFFF) for sui in range(1, number + 1))
        before, lost = escaped(modules, frames, WITHOUT)
        after, _ = escaped(modules, frames, cyskin.EXCESS_MAX)
        what = f"{number} modules, {frames} frames"
        found += [
            (f"{what}: packets damaged", float(lost), None),
            ("  taken for whole without the rule", float(before), None),
            ("  taken for whole", float(after), None),
        ]
    return found


def escaped(modules: Sequence[Module], frames: int, excess_max: int) -> tuple[int, int]:
    """Packets that were delivered and never sent, and packets sent that did not arrive."""
    hub, rng, link = VirtualIhb(modules), random.Random(0), Reassembler()
    channels = sum(module.channels for module in modules)
    escapes = arrived = sent = 0
    with mock.patch.object(cyskin, "EXCESS_MAX", excess_max):
        while link.counters.frames < frames:
            counts = [rng.randint(8_000, 30_000) for _ in range(channels)]
            packets = [cyskin.encode(*answer) for answer in hub.sensor_data(counts)]
            sent += len(packets)
            for frame in damaged(
                rng, [f for packet in packets for f in cyskin.fragment(packet, 1)]
            ):
                packet = link.feed(frame)
                if packet is not None:
                    whole = cyskin.encode(packet.command, packet.payload) in packets
                    arrived += whole
                    escapes += not whole
    return escapes, sent - arrived


def damaged(rng: random.Random, frames: Sequence[Frame]) -> Iterator[Frame]:
    """What arrives of them."""
    held: list[Frame] = []
    for frame in frames:
        what = int(rng.random() / SHARE)
        if what == 0:
            continue
        if what == 1 and not held:
            held.append(frame)
            continue
        yield frame
        if what == 2:
            yield frame
        yield from held
        held.clear()
    yield from held


if __name__ == "__main__":
    raise SystemExit(main())
