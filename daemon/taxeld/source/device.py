"""What a device is to the source that reads it."""

from dataclasses import dataclass, field
from typing import Protocol

from taxeld.errors import SetupError
from taxeld.source.outbox import Unit
from taxeld.source.session import Chunk
from taxeld_protocol.frames import Frame


class LostError(Exception):
    """The device is gone."""


class AwayError(SetupError):
    """A device that is missing or busy: it may be had later."""


class BusyError(AwayError):
    """Another process has it."""


@dataclass(slots=True)
class Noticed:
    """What a device has noticed of itself."""

    noise: int = 0  # reads that could not be decoded
    foreign: int = 0  # frames that are no classic data frames
    refused: int = 0  # lines that an SLCAN adapter refused,
    silences: int = 0  # and times that it fell silent
    lines: list[str] = field(default_factory=list)  # for the log


class Device(Protocol):
    """An open CAN interface or serial line."""

    noticed: Noticed  # since its reader has put another in its place

    @property
    def waits_for(self) -> str:
        """What must come before anything can, in a line; empty where nothing must."""
        ...

    def fileno(self) -> int:
        """Readable when something has arrived; negative: this one cannot be waited on."""
        ...

    def read(self) -> list[Frame] | list[Chunk]:
        """What has arrived. Raises LostError."""
        ...

    def tend(self, now_s: float) -> None:
        """Do what the device needs beside requests; `now_s` is monotonic. Raises LostError."""

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        """A request, to be broadcast."""
        ...

    def put(self, unit: Unit) -> Unit | None:
        """As `outbox.Taker` says."""
        ...

    def close(self, wait_s: float = 0.0) -> None:
        """Close; what was written last may take `wait_s` to get out, and is lost then."""
        ...
