"""From frames or bytes to packets and scans: the same for live sources, recordings and replays."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source.session import Chunk
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialCounters, SerialReader
from taxeld_protocol.slcan import SlcanReader


class Decoded(NamedTuple):
    """A packet, if one is complete, and the scans that it ended."""

    packet: Packet | None
    scans: list[Scan]


class Wire:
    """Frames of a CAN bus, bytes of a serial line, or arrays, through the decoder."""

    def __init__(self, config: SourceConfig, decoder: Decoder | ArrayDecoder) -> None:
        self.decoder = decoder
        self._slcan = SlcanReader() if config.framing == "slcan" else None
        self._native = SerialReader()

    def take(self, items: Sequence[Frame | Chunk | ArrayFrame]) -> list[Decoded]:
        """Take frames or chunks with their own stamps; frames that end nothing are left out."""
        heard: list[Decoded] = []
        feed: Callable[[Any], tuple[Packet | None, list[Scan]]] = self.decoder.feed
        for item in items:
            if not isinstance(item, Chunk):
                packet, scans = feed(item)
                if scans or packet is not None:
                    heard.append(Decoded(packet, scans))
            else:
                heard += self.data(item.data, item.t)
        return heard

    def data(self, data: bytes, t: float) -> list[Decoded]:
        """Take bytes of a serial line, in pieces of any size, that were read at time `t`; frames
        that end nothing are left out.

        Raises:
            SetupError: the dialect has no packets, but the line carries packets.
        """
        if self._slcan is not None:
            foreign = self._slcan.counters.foreign
            heard = self.take(self._slcan.feed(data, t))
            for _ in range(self._slcan.counters.foreign - foreign):
                self.decoder.drop_foreign()
            return heard
        if not isinstance(self.decoder, Decoder):
            raise SetupError("source.framing: 'native' carries CySkin packets alone; use slcan")
        packets = self._native.feed(data, t)
        return [Decoded(packet, self.decoder.on_packet(packet)) for packet in packets]

    def stats(self) -> dict[str, object]:
        """The decoder's counters, and the line's own."""
        reader = self._native if self._slcan is None else self._slcan
        line = reader.counters
        stats: dict[str, object] = {
            **self.decoder.stats(),
            "bytes": line.bytes,
            "bytes_used": line.used,
            "bytes_dropped": line.bytes - line.used - reader.pending,
        }
        if isinstance(line, SerialCounters) and line.bytes:  # the serial link checks packets itself
            stats["packets"] = line.packets
            stats["crc_errors"] = line.crc_errors
            stats["length_errors"] = line.length_errors
        return stats
