"""From frames or bytes to packets and scans: the same for live sources, recordings and replays."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from taxeld.source.session import Chunk
from taxeld_protocol.array import ArrayDecoder, ArrayFrame
from taxeld_protocol.cyskin import Packet
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import SerialReader


class Decoded(NamedTuple):
    """A packet, if one is complete, and the scans that it ended."""

    packet: Packet | None
    scans: list[Scan]


class Wire:
    """Frames of a CAN bus, bytes of a serial line, or arrays, through the decoder."""

    def __init__(self, decoder: Decoder | ArrayDecoder) -> None:
        self.decoder = decoder
        self._native = SerialReader()

    def take(self, items: Sequence[Frame | Chunk | ArrayFrame]) -> list[Decoded]:
        """Take frames or chunks with their own stamps; → the packets that they complete."""
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
        """Take bytes of a serial line, in pieces of any size, that were read at time `t`; → the
        packets that they complete."""
        assert isinstance(self.decoder, Decoder)  # noqa: S101  (an array comes by no line)
        packets = self._native.feed(data, t)
        return [Decoded(packet, self.decoder.on_packet(packet)) for packet in packets]

    @property
    def packets(self) -> int:
        """Number of good packets of a serial line."""
        return self._native.counters.packets

    def stats(self) -> dict[str, object]:
        """The decoder's counters, and the line's own."""
        line = self._native.counters
        stats: dict[str, object] = {
            **self.decoder.stats(),
            "bytes": line.bytes,
            "bytes_used": line.used,
            "bytes_dropped": line.bytes - line.used - self._native.pending,
        }
        if line.bytes:  # the serial link checks packets itself
            stats["packets"] = line.packets
            stats["crc_errors"] = line.crc_errors
            stats["length_errors"] = line.length_errors
        return stats
