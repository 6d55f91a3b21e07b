"""What it costs to read an SLCAN adapter: the daemon's own reader, and python-can's beside it.

Both read the same frames from a pseudo-terminal in the same run, by turns, as a loop of 100 ticks a
second would find them. CPU time of the reading alone.
"""

import fcntl
import os
import select
import statistics
import sys
import termios
import time
import tty
from collections.abc import Callable
from contextlib import closing

from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.layout import read as layouts
from taxeld.source.can_device import CanDevice
from taxeld.source.device import Device
from taxeld.source.devices import open_device
from taxeld_protocol import cyskin, slcan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

TICKS_S = 100  # of the loop, a second
SCANS_S = 20
SATURATED_FRAMES_S = 9_000  # of a 1 Mbit/s bus with 8-byte frames
ROUNDS = 5  # of a second
Row = tuple[str, float, float | None]


def rows() -> list[Row]:
    """(figure, measured, budget) of everything here."""
    scan = skin_frames()
    sparse = [scan if tick % (TICKS_S // SCANS_S) == 0 else [] for tick in range(TICKS_S)]
    a_tick = SATURATED_FRAMES_S // TICKS_S
    saturated = [(scan * (a_tick // len(scan) + 1))[:a_tick]] * TICKS_S
    found: list[Row] = []
    for name, second in (("80 taxels at 20 Hz", sparse), ("a saturated bus", saturated)):
        own, other = shares(second)
        found += [
            (f"a core's share, an SLCAN adapter with {name}: %", own, None),
            ("  … by python-can's reader: %", other, None),
        ]
    return found


def skin_frames() -> list[Frame]:
    """A scan of the default skin."""
    hub = VirtualIhb(wired(layouts.load(SkinConfig().layout).uid.tolist()))
    channels = sum(module.channels for module in hub.modules)
    return [
        frame
        for command, payload in hub.sensor_data([10_000 + 7 * i for i in range(channels)])
        for frame in cyskin.to_frames(command, payload, ihb=1)
    ]


def shares(second: list[list[Frame]]) -> tuple[float, float]:
    """A core's share [%] of both readers, for ticks that find these frames."""
    spent: tuple[list[float], list[float]] = ([], [])
    with closing(Line(open_device)) as own, closing(Line(CanDevice)) as other:
        for _ in range(ROUNDS):
            for line, times in zip((own, other), spent, strict=True):
                times.append(sum(line.tick(frames) for frames in second))
    return 100.0 * statistics.median(spent[0]), 100.0 * statistics.median(spent[1])


class Line:
    """A pseudo-terminal with a reader of the daemon's at one end."""

    def __init__(self, reader: Callable[..., Device]) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        channel = os.ttyname(self._slave)
        config = SourceConfig(kind="can", interface="slcan", channel=channel, listen_only=True)
        self._device = reader(config, lambda *_: [])

    def tick(self, frames: list[Frame]) -> float:
        """→ CPU seconds to read them. They come in one piece."""
        if frames:
            data = b"".join(map(slcan.encode, frames))
            assert os.write(self._master, data) == len(data)
            self._wait_for(len(data))
        began = time.process_time()
        found = list(self._device.read())
        while len(found) < len(frames):  # python-can's line may end in mid-read
            found += self._device.read()
        spent = time.process_time() - began
        assert [frame.data for frame in found] == [frame.data for frame in frames]
        return spent

    def _wait_for(self, size: int) -> None:
        """Until the kernel has it all on the reader's side."""
        assert select.select([self._slave], [], [], 5.0)[0]
        while self._waiting() < size:
            time.sleep(1e-4)

    def _waiting(self) -> int:
        return int.from_bytes(fcntl.ioctl(self._slave, termios.FIONREAD, bytes(4)), sys.byteorder)

    def close(self) -> None:
        self._device.close()
        os.close(self._master)
        os.close(self._slave)


if __name__ == "__main__":
    for figure, measured, _ in rows():
        print(f"{figure:60s} {measured:8.3f}")
