"""A device that connects a skin: its interface to the source that reads it, and its faults."""

import errno
import os
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from taxeld.errors import SetupError
from taxeld.source.bus_faults import BusFault
from taxeld_protocol import cyskin
from taxeld_protocol.frames import Chunk, Frame

FRAMES_PER_POLL = 1000  # limit on a pass, so that a flooded bus cannot hold the loop
FOREIGN_CLOCK_S = 86_400.0  # a stamp farther from now is not from this machine's clock

ABSENT = "it is not there; is it plugged in?"
DENIED = (
    "permission denied; is this user in the group that owns it? One of root's needs a udev rule"
)
REASONS = {  # words in place of the system's own
    errno.ENOENT: ABSENT,
    errno.ENODEV: ABSENT,
    errno.ENXIO: ABSENT,
    errno.EACCES: DENIED,
    errno.EPERM: DENIED,
    errno.EAFNOSUPPORT: "this kernel has no CAN: 'modprobe -a can can_raw' loads it, and an SLCAN "
    'adapter, source.interface = "slcan", does without',
    errno.ENOTTY: "it is no serial line",
    errno.EISDIR: "it is a directory",
}
BUSY = {errno.EAGAIN, errno.EBUSY}
# faults that waiting does not cure
FOR_A_PERSON = {errno.EACCES, errno.EPERM, errno.ENOTTY, errno.EISDIR}


class LostError(Exception):
    """The device is gone."""


class AwayError(SetupError):
    """A device that is missing or busy now, and may be opened later."""


class BusyError(AwayError):
    """A device that another process has open."""


def unopened(where: str, error: Exception) -> SetupError:
    """The exception for `error` when opening a device at `where`."""
    number = _errno(error)
    if number in BUSY:
        return BusyError(
            f"source.channel: cannot open {where} (another process has it open; stop that first, "
            f"'fuser {where}' tells which)"
        )
    reason = REASONS.get(number) or (os.strerror(number) if number > 0 else first_line(error))
    for_a_person = number in FOR_A_PERSON or (not number and isinstance(error, ValueError))
    kind = SetupError if for_a_person else AwayError
    return kind(f"source.channel: cannot open {where} ({reason})")


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _errno(error: BaseException | None) -> int:
    """The system's number of the fault behind an exception; 0 where there is none."""
    while error is not None:
        number = getattr(error, "errno", None) or next(iter(error.args), None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return 0


def request_frame(to: int, command: int, payload: bytes) -> Frame:
    """A request as a frame of a bus; no request needs more than one."""
    [frame] = cyskin.to_frames(command, payload, ihb=to, t=time.time())
    return frame


@dataclass(slots=True)
class Noticed:
    """Faults that a device has noticed since they were last taken."""

    foreign: int = 0  # frames that are neither classic data frames nor error frames
    bus: Counter[BusFault] = field(default_factory=Counter)  # faults of a CAN bus
    lines: list[str] = field(default_factory=list)  # lines for the log


class Device(ABC):
    """An open CAN interface or serial line. Neither reading nor writing waits."""

    waits_for = ""  # a line on why nothing comes; empty where nothing is amiss
    is_starting = False  # whether the skin behind it is being started, and so may be silent

    def __init__(self) -> None:
        self.noticed = Noticed()  # faults so far; the reader takes them and leaves a fresh object

    def fileno(self) -> int:
        """A descriptor that is readable when something has arrived; negative without one."""
        return -1

    @abstractmethod
    def read(self) -> Sequence[Frame | Chunk]:
        """The frames of a bus, or the bytes of a line, that have arrived. Raises LostError."""

    @abstractmethod
    def send(self, to: int, command: int, payload: bytes) -> Frame | None:
        """Send a request whole, some of it perhaps later; → the frame that goes to a bus.

        Raises:
            BlockingIOError: the device takes nothing now.
            LostError: the device is gone.
        """

    def tend(self, now_s: float) -> None:  # noqa: B027  (most have none)
        """Do work beside requests; `now_s` is monotonic. Raises LostError."""

    @abstractmethod
    def close(self, wait_s: float = 0.0) -> None:
        """Close. The last written bytes have `wait_s` to leave, and are lost after that."""


class BusDevice(Device):
    """A CAN interface that gives and takes one frame after the other."""

    def __init__(self) -> None:
        super().__init__()
        self._fault: OSError | None = None  # reported after the frames that came before it

    def read(self) -> Sequence[Frame]:
        frames: list[Frame] = []
        now = time.time()
        for _ in range(FRAMES_PER_POLL):
            try:
                frame = self._receive()
            except (BlockingIOError, ValueError):
                break
            except OSError as error:
                self._fault = error
                break
            if frame is not None:
                is_of_now = abs(frame.t - now) < FOREIGN_CLOCK_S
                frames.append(frame if is_of_now else frame._replace(t=now))
        if self._fault is not None and not frames:
            raise LostError from self._fault
        return frames

    def send(self, to: int, command: int, payload: bytes) -> Frame:
        frame = request_frame(to, command, payload)
        try:
            self._send(frame)
        except OSError as error:  # full or down; reading finds a lost device
            raise BlockingIOError from error
        return frame

    @abstractmethod
    def _receive(self) -> Frame | None:
        """The next frame; None for one that is not a classic data frame, and was noticed.

        Raises:
            BlockingIOError: there is none now.
            ValueError: it could not be decoded.
            OSError: the device is gone.
        """

    @abstractmethod
    def _send(self, frame: Frame) -> None:
        """Raises OSError where the frame is not taken."""
