"""The interface of a device to the source that reads it."""

from dataclasses import dataclass, field
from typing import Protocol

from taxeld.errors import SetupError
from taxeld.source.outbox import Unit
from taxeld.source.session import Chunk
from taxeld_protocol.frames import Frame


class LostError(Exception):
    """The device is gone."""


class AwayError(SetupError):
    """A device that is missing or busy now, and may be opened later."""


class BusyError(AwayError):
    """A device that another process has open."""


@dataclass(slots=True)
class Noticed:
    """Faults that a device has noticed since they were last taken."""

    noise: int = 0  # reads that could not be decoded
    foreign: int = 0  # frames that are not classic data frames
    refused: int = 0  # lines that an SLCAN adapter refused
    silences: int = 0  # times that an SLCAN adapter fell silent
    lines: list[str] = field(default_factory=list)  # lines for the log


class Device(Protocol):
    """An open CAN interface or serial line."""

    noticed: Noticed  # faults so far; the reader takes them and leaves a fresh object

    @property
    def waits_for(self) -> str:
        """A line on why nothing comes; empty where nothing is amiss."""
        ...

    def fileno(self) -> int:
        """A descriptor that is readable when something has arrived; negative where there is
        none."""
        ...

    def read(self) -> list[Frame] | list[Chunk]:
        """The frames of a bus, or the bytes of a line, that have arrived. Raises LostError."""
        ...

    def tend(self, now_s: float) -> None:
        """Do work beside requests; `now_s` is monotonic. Raises LostError."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        """A request as units for a broadcast."""
        ...

    def put(self, unit: Unit) -> Unit | None:
        """Hand over a unit, by the rules of `outbox.Taker`."""
        ...

    def close(self, wait_s: float = 0.0) -> None:
        """Close. The last written bytes have `wait_s` to leave, and are lost after that."""
        ...
