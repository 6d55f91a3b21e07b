"""Serial lines, locked while they are open: a hub's own link, and SLCAN adapters of a CAN bus.

An adapter's channel is opened step by step: the next command is sent when the last one was
answered, or after ANSWER_S, as some adapters answer nothing. A channel without frames is closed and
opened again, whatever closed it: another process, a supply that failed, another bit rate.
"""

import contextlib
import math
import os
import select
import termios
import time
from collections.abc import Sequence

import serial

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.bus_faults import POWER, WIRING
from taxeld.source.device import Device, LostError, request_frame, unopened
from taxeld_protocol import serial_link, slcan
from taxeld_protocol.cyskin import LEAVE_BOOTLOADER
from taxeld_protocol.frames import Chunk, Frame
from taxeld_protocol.serial_link import DELIMITER

BYTES_PER_POLL = 65536
SPEEDS = range(1200, 12_000_001)  # bit/s
LINK_BAUD, ADAPTER_BAUD = 921_600, 115_200  # where the channel names none, as /dev/ttyACM0@9600
ANSWER_S = 0.2  # time for an answer; an adapter on USB needs about 0.02
SILENCE_S = 1.0  # time without a frame after which the channel is opened again
SILENT_PERIODS = 2.5  # scan periods of silence before reopening, if longer than SILENCE_S
LEAVE_S = 0.02  # time for the last requests to leave an adapter, before its channel is closed

CLOSE = b"C\r"
CLOSE_TWICE = 2 * CLOSE  # the first CLOSE may only end an unfinished line of an earlier host
OPEN = b"O\r"
LISTEN = b"L\r"  # opens to listen only; CANable's firmware does not know it
SILENT, NORMAL = b"M1\r", b"M0\r"  # CANable's: whether the next OPEN listens only
# A channel may be closed already, and not every adapter knows M0 and L.
MAY_BE_REFUSED = (b"", CLOSE_TWICE, LISTEN, NORMAL)
REFUSALS = {  # first letter of a refused line → reason and cure
    b"S": "it knows no such bit rate: source.bitrate must be one that it does",
    b"O": "its channel does not open; is the bit rate one that it knows?",
    b"M": "it cannot listen only: set source.listen_only = false, or use another",
    b"T": "its channel is closed, or its buffer full",
}
FRAMES = (b"t", b"T", b"r", b"R", b"d", b"D", b"b", b"B")  # first letters of a frame's line
SHORTEST = 5  # bytes of a frame's line


def line_of(channel: str, usual: int) -> tuple[str, int]:
    """The device and line speed in a `channel`; the `usual` one where it names none.

    Raises:
        SetupError: the text after its @ is no line speed.
    """
    path, at, baud = channel.partition("@")
    if not at:
        return path, usual
    if len(baud) > len(str(SPEEDS[-1])) or not baud.isdecimal() or int(baud) not in SPEEDS:
        raise SetupError(
            f"source.channel: {channel} must end with @ and a line speed, as {path}@{usual}"
        )
    return path, int(baud)


class SerialLine(Device):
    def __init__(self, where: str, baud: int) -> None:
        super().__init__()
        self._rest = b""  # rest of a request of which the line has taken a part
        try:
            self._port = serial.Serial(where, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise unopened(where, error) from None
        self._ended = select.poll()  # pyserial's `read` uses `select`: no descriptor over 1023
        self._ended.register(self._port.fileno(), 0)

    def fileno(self) -> int:
        return int(self._port.fileno())

    def tend(self, now_s: float) -> None:  # noqa: ARG002
        self._send_rest()

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._drain(wait_s)
            if self._port.out_waiting:  # otherwise the kernel waits for these up to 30 s
                self._port.reset_output_buffer()
        with contextlib.suppress(OSError):
            self._port.close()

    def _receive(self) -> bytes:
        try:
            data = os.read(self._port.fileno(), BYTES_PER_POLL)
            if not data and self._ended.poll(0):
                raise OSError("the line has ended: is it unplugged?")
        except BlockingIOError:
            return b""
        except OSError as error:
            raise LostError from error
        return data

    def _put(self, data: bytes) -> None:
        """Send data whole, some of it perhaps later: half a request would spoil the next one.
        Raises BlockingIOError where the line takes nothing, and LostError."""
        taken = 0 if self._send_rest() else self._write(data)
        if not taken:
            raise BlockingIOError
        self._rest = data[taken:]

    def _send_rest(self) -> bytes:
        """Send what is left of the last request; → the part that is left now. Raises LostError."""
        if self._rest:
            self._rest = self._rest[self._write(self._rest) :]
        return self._rest

    def _write(self, data: bytes) -> int:
        """Write without waiting; → the number of bytes taken. Raises LostError."""
        try:
            # pyserial's `write` either waits or, told not to, spins while the line is full
            return os.write(self._port.fileno(), data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LostError from error

    def _drain(self, wait_s: float) -> None:
        deadline = time.monotonic() + wait_s
        with contextlib.suppress(LostError):
            while (self._send_rest() or self._port.out_waiting) and time.monotonic() < deadline:
                time.sleep(wait_s / 20.0)


class SerialDevice(SerialLine):
    """A hub's own link on a serial line."""

    def __init__(self, config: SourceConfig) -> None:
        super().__init__(*line_of(config.channel, LINK_BAUD))

    def read(self) -> list[Chunk]:
        data = self._receive()
        return [Chunk(time.time(), data)] if data else []

    def send(self, to: int, command: int, payload: bytes) -> None:
        # a hub that speaks this link runs its application, so that one request only ends a line
        is_leave = command == LEAVE_BOOTLOADER
        self._put(DELIMITER if is_leave else serial_link.encode(command, payload, ihb=to))


class SlcanDevice(SerialLine):
    """`source.interface = "slcan"`."""

    def __init__(self, config: SourceConfig) -> None:
        """Raises SetupError where the line cannot be opened."""
        self._where, baud = line_of(config.channel, ADAPTER_BAUD)
        super().__init__(self._where, baud)
        self._reader = slcan.SlcanReader()
        self._listen_only = config.listen_only
        quiet = (LISTEN, SILENT) if self._listen_only else (NORMAL,)
        self._opening = [CLOSE_TWICE, slcan.BITRATES[config.bitrate] + slcan.CR, *quiet, OPEN]
        self._steps = list(self._opening)  # commands still to be sent
        self._line = b""  # command or frame sent last: an answer is taken to be for it
        self._answer: bool | None = None  # whether a command was accepted; None: not answered yet
        self._step_s = -math.inf  # monotonic time of the last command
        self._heard_s = math.inf  # monotonic time of the last frame, or of the last command
        self._silence_s = max(SILENCE_S, SILENT_PERIODS * config.period_ms / 1000.0)
        self._frame_came = False  # whether a frame came since the last `tend`
        self._complained: set[bytes] = set()  # first letters of refused lines that were logged

    def read(self) -> Sequence[Frame]:
        data, now, foreign = self._receive(), time.time(), self._reader.foreign
        frames = self._reader.feed(data, now)
        self._frame_came |= bool(frames)
        for line in self._reader.others:
            if line[-1:] == slcan.BEL:
                self._answer = False
                self._refused()
            elif len(line) >= SHORTEST and line.startswith(FRAMES):
                self._frame_came = True
            elif line in slcan.ACCEPTED:
                self._answer = True
        self.noticed.foreign += self._reader.foreign - foreign
        return frames

    def tend(self, now_s: float) -> None:
        """Open the channel, and open it again when frames stop."""
        if self._frame_came:
            self._frame_came, self.waits_for = False, ""
            self._heard_s = now_s
        if self.is_starting:
            self._heard_s = now_s
        if now_s >= self._heard_s + self._silence_s:
            self._begin_anew()
            self._heard_s = now_s
        if not self._send_rest() and self._steps and self._may_go_on(now_s):
            self._line = self._rest = self._steps.pop(0)
            self._answer = None
            self._step_s = self._heard_s = now_s
            self._send_rest()

    def send(self, to: int, command: int, payload: bytes) -> Frame:
        if self._steps:
            raise BlockingIOError
        frame = request_frame(to, command, payload)
        line = slcan.encode(frame)
        self._put(line)
        self._line = line
        return frame

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            if self._line:
                self._drain(wait_s)
                time.sleep(min(wait_s, LEAVE_S))
                os.write(self._port.fileno(), CLOSE + NORMAL if self._listen_only else CLOSE)
        super().close(wait_s)

    def _begin_anew(self) -> None:
        """Open the channel again after a silence."""
        every = f"{self._silence_s:g} s"
        self.waits_for = (
            f"source.channel: nothing has come from {self._where} for {every}; {POWER}, and "
            f"{WIRING}; its channel is opened again every {every}"
        )
        try:
            # another process that closed the channel may have set the line otherwise
            self._port.baudrate = self._port.baudrate
        except (OSError, termios.error) as error:
            raise LostError from error
        self._steps = list(self._opening)
        self._line, self._answer, self._step_s = b"", None, -math.inf

    def _may_go_on(self, now_s: float) -> bool:
        """Whether the next step may be taken; the last answer ends the steps."""
        if self._line == CLOSE_TWICE or self._answer is None:
            return now_s >= self._step_s + ANSWER_S
        if (self._line == LISTEN and self._answer) or (self._line == SILENT and not self._answer):
            self._steps.clear()  # it listens, or it cannot listen only and stays closed
        return bool(self._steps)

    def _refused(self) -> None:
        """Log the first refused line of its kind."""
        line, kind = self._line, self._line[:1].upper()
        if line not in MAY_BE_REFUSED and kind not in self._complained:
            self._complained.add(kind)
            name = line.removesuffix(slcan.CR).decode()
            cure = REFUSALS.get(kind, "is it another kind of adapter?")
            self.noticed.lines.append(f"source.channel: {self._where} refused {name} ({cure})")
