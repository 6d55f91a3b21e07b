"""An SLCAN adapter on a serial line, with the bus behind it. Neither reading nor writing waits."""

import contextlib
import os
import termios
import time

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.device import LostError
from taxeld.source.dialects import ToFrames
from taxeld.source.lines import SerialLine, line_speed
from taxeld.source.outbox import Unit
from taxeld.source.session import Chunk
from taxeld_protocol import slcan
from taxeld_protocol.frames import Frame
from taxeld_protocol.slcan_adapter import CLOSE, Adapter

ADAPTER_BAUD = 115_200  # of an SLCAN adapter whose channel names no other: /dev/ttyACM0@921600
SILENCE_S = 1.0  # from an adapter: then its channel is opened again
SILENT_PERIODS = 2.5  # … at least, where the skin's scans are that far apart
LEAVE_S = 0.02  # for the last requests to leave an adapter, before its channel is closed
REFUSALS = {  # lines of an adapter's host, by their first letter: why, and what to do
    b"S": "it knows no such bit rate: source.bitrate must be one that it does",
    b"O": "its channel does not open; is the bit rate one that it knows?",
    b"M": "it cannot listen only: set source.listen_only = false, or use another",
    b"t": "its channel is closed, or its buffer full",
    b"T": "its channel is closed, or its buffer full",
}


def adapter_line(channel: str) -> tuple[str, int]:
    """The device and line speed that an SLCAN `channel` names.

    Raises:
        SetupError: what follows its @ is no line speed.
    """
    path, at, baud = channel.partition("@")
    speed = line_speed(baud) if at else ADAPTER_BAUD
    if speed is None:
        raise SetupError(
            f"source.channel: {channel} must end with @ and a line speed, as {path}@{ADAPTER_BAUD}"
        )
    return path, speed


class SlcanDevice(SerialLine):
    """An SLCAN adapter: of kind can a bus, whose frames are recorded; of kind serial a line, whose
    bytes are."""

    def __init__(self, config: SourceConfig, to_frames: ToFrames) -> None:
        self._is_bus = config.kind == "can"
        line = adapter_line(config.channel) if self._is_bus else (config.channel, config.baud)
        super().__init__(*line)
        self._where = line[0]
        silence_s = max(SILENCE_S, SILENT_PERIODS * config.period_ms / 1000.0)
        self._adapter = Adapter(config.bitrate, listen_only=config.listen_only, silence_s=silence_s)
        self._to_frames = to_frames
        self._reader = slcan.SlcanReader()
        self._commands = b""  # that the line has not taken yet
        self._begun = b""  # a request of which it has taken a part: no command may cut into it
        self._now_s = 0.0

    @property
    def waits_for(self) -> str:
        if not self._adapter.is_silent:
            return ""
        every = f"{self._adapter.silence_s:g} s"
        return (
            f"source.channel: nothing has come from {self._where} for {every}; "
            f"its channel is opened again every {every}"
        )

    def read(self) -> list[Frame] | list[Chunk]:
        data, now = self._receive(), time.time()
        lines = self._reader.lines(data)
        self._adapter.hear(lines)
        if not self._is_bus:  # the bytes are parsed where those of a recording are
            return [Chunk(now, data)] if data else []
        counters = self._reader.counters
        noise, foreign = counters.noise, counters.foreign
        frames = self._reader.frames(lines, now)
        self.noticed.noise += counters.noise - noise
        self.noticed.foreign += counters.foreign - foreign
        return frames

    def tend(self, now_s: float) -> None:
        """Open the channel, and open it again once nothing comes from it."""
        self._now_s = now_s
        if due := self._adapter.due(now_s):
            self._add(due)
        if self._commands and not self._begun:
            self._commands = self._commands[self._write(self._commands) :]
        if self._adapter.refused or self._adapter.silences:
            self._notice()

    def pack(self, command: int, payload: bytes) -> list[Unit]:
        frames = self._to_frames(command, payload)
        return [Unit(f if self._is_bus else None, slcan.encode(f)) for f in frames]

    def put(self, unit: Unit) -> Unit | None:
        if not self._begun and (self._commands or not self._adapter.is_open):
            raise BlockingIOError
        rest = super().put(unit)
        line = self._begun or unit.line
        if rest is None:
            self._adapter.sent(line, self._now_s)
        self._begun = b"" if rest is None else line
        return rest

    def close(self, wait_s: float = 0.0) -> None:
        with contextlib.suppress(OSError, termios.error):
            self._drain(wait_s)
            time.sleep(min(wait_s, LEAVE_S))
            os.write(self._port.fileno(), self._adapter.closing())
        super().close(wait_s)

    def _add(self, commands: bytes) -> None:
        if commands.startswith(CLOSE):
            self._set_line()
            self._commands = b""  # of an opening that the line has not taken
        self._commands += commands

    def _notice(self) -> None:
        adapter, noticed = self._adapter, self.noticed
        noticed.refused += adapter.refused
        noticed.silences += adapter.silences
        adapter.refused = adapter.silences = 0
        for line in adapter.complaints:
            cure = REFUSALS.get(line[:1], "is it another kind of adapter?")
            noticed.lines.append(f"source.channel: {self._where} refused {line.decode()} ({cure})")
        adapter.complaints.clear()

    def _set_line(self) -> None:
        """Whoever closed the channel may have set the line otherwise as well."""
        try:
            self._port.baudrate = self._port.baudrate
        except (OSError, termios.error) as error:
            raise LostError from error
