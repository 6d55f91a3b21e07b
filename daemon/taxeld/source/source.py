"""A source as the loop sees it."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from taxeld.source.bus_faults import BusHealth
from taxeld.source.device import Device
from taxeld.source.wire import Wire
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.decoder import Scan


@dataclass(slots=True)
class SourceCounters:
    """Counters of a source, since start."""

    lost: int = 0  # times the device was lost
    reopened: int = 0
    unopened: int = 0  # attempts to open it that failed
    unsent: int = 0  # requests that the device did not take in time


class Source:
    """A source of scans, which is polled at every pass."""

    device: Device | None = None  # the open device; the loop waits on its descriptor
    comes_by_door = False  # whether its frames come by the door, which gives them to `hear`
    is_busy = True  # whether it must be polled at every tick, as no descriptor would wake the loop
    waits_for = ""  # a line on why no scans come; empty where nothing is amiss
    fault = ""  # a line on why no scan can ever be used; empty where nothing is amiss
    firmware: Mapping[str, str] = MappingProxyType({})  # short id of a hub → its versions, in words

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.counters = SourceCounters()
        self.bus = BusHealth()  # of a CAN bus

    def gather(self) -> int:
        """Read the device and keep the items for the next `poll`; → the number of frames, or of
        bytes of a line, now kept."""
        return 0

    def poll(self, now_s: float) -> list[Scan]:
        """Scans that have arrived; `now_s` is monotonic."""
        raise NotImplementedError

    def hear(self, frame: ArrayFrame) -> None:
        """A frame of an array has come by the door."""

    def heed(self, *, connected: bool, malformed: int, reason: str) -> None:
        """The door's report on an array: whether somebody sends it, the number of messages that
        were no arrays, and why the last of them was not."""

    def close(self) -> None:
        """Stop the skin and close the device, if there is one."""
