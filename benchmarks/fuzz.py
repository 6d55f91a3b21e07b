"""The coverage-guided fuzzer's target on the wire: any bytes as frames and lines of each link.

Nothing may raise, and what is fed is used, dropped or pending. Findings become tests.
"""

import sys

import atheris

with atheris.instrument_imports():
    from taxeld_protocol import slcan
    from taxeld_protocol.decoder import Decoder
    from taxeld_protocol.frames import Frame, parse_log_line
    from taxeld_protocol.icub_decoder import IcubDecoder
    from taxeld_protocol.serial_link import SerialReader
    from taxeld_protocol.slcan import SlcanReader


def one_input(data: bytes) -> None:
    provider = atheris.FuzzedDataProvider(data)
    which = provider.ConsumeIntInRange(0, 3)
    if which == 0:
        decoder = Decoder() if provider.ConsumeBool() else IcubDecoder()
        while provider.remaining_bytes():
            can_id = provider.ConsumeIntInRange(0, 0x7FF)
            payload = provider.ConsumeBytes(provider.ConsumeIntInRange(0, 8))
            decoder.feed(Frame(0.0, can_id, payload))
        stats = decoder.stats()
        used = stats["used"] + sum(stats["dropped"].values()) + stats["pending"]
        assert used == stats["frames"]
    elif which == 1:
        reader, decoder = SerialReader(), Decoder()
        while provider.remaining_bytes():
            piece = provider.ConsumeBytes(provider.ConsumeIntInRange(1, 64))
            for packet in reader.feed(piece, 0.0):
                decoder.on_packet(packet)
        assert reader.counters.used + reader.pending <= reader.counters.bytes
    elif which == 2:
        lines = SlcanReader()
        lines.feed(provider.ConsumeBytes(600), 0.0)
        assert lines.counters.used + lines.pending <= lines.counters.bytes
        slcan.parse(data)
    else:
        parse_log_line(provider.ConsumeUnicode(200))


atheris.Setup(sys.argv, one_input)
atheris.Fuzz()
