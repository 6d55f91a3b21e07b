"""`taxeld decode`: a candump log as JSON lines, one a scan, and then what became of every frame."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.source.module_order import Given, missing
from taxeld_protocol.cyskin import Command
from taxeld_protocol.decoder import Decoder, Scan, ScanDecoder
from taxeld_protocol.frames import Frame, LogLine, parse_log_line
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.modules import NAMES, Module


def decode(path: Path, given: Given | None = None, dialect: str = "cyskin") -> Iterator[str]:
    """The log's scans and a last line {"stats": …}.

    The module table of a CySkin hub is what its DECLARE and DETAILS answers say, wherever in the
    log they stand; else what `given` lists; without it, full modules of twelve channels, as many as
    its packets reach. That of an iCub board is the triangles that it sends.

    Raises:
        SetupError: the log is unreadable or holds no frame at all, or `given` has none of its hubs.
    """
    frames: list[Frame] = []
    bad_lines = 0
    for line in _log_lines(path):
        if line.frame is None:
            bad_lines += 1
        else:
            frames.append(line.frame)
    if not frames:
        raise SetupError(f"{path}: holds no candump line; expected '(t) can0 101#431A…'")
    decoder: ScanDecoder
    if dialect == "icub":
        decoder = IcubDecoder()
    else:
        tables = _tables(frames, given, path)
        decoder = Decoder(lambda ihb: tables.get(ihb, ()))
    for frame in frames:
        yield from map(_line, decoder.feed(frame)[1])
    yield from map(_line, decoder.flush())
    yield _json({"stats": {**decoder.stats(), "bad_lines": bad_lines}})


def _log_lines(path: Path) -> Iterator[LogLine]:
    """The lines of a candump log; damaged ones with no frame, empty ones left out."""
    try:
        with path.open(encoding="ascii", errors="replace") as file:
            for number, text in enumerate(file, 1):
                if text.strip():
                    yield LogLine(number, parse_log_line(text.rstrip("\n")))
    except OSError as error:
        raise SetupError(f"{path}: unreadable log ({error.strerror})") from None


def _tables(frames: list[Frame], given: Given | None, path: Path) -> dict[int, Sequence[Module]]:
    """The module table of each hub of the log."""
    decoder = Decoder()
    reached: dict[int, int] = {}  # channels of full modules that each hub's packets run through
    for frame in frames:
        packet, _ = decoder.feed(frame)
        if packet is not None and packet.command == Command.SENSOR_DATA and packet.payload:
            module, channel, values = *packet.payload[:2], len(packet.payload) // 2 - 1
            end = module * NAMES + channel + values
            reached[packet.ihb] = max(reached.get(packet.ihb, 0), end)
    tables: dict[int, Sequence[Module]] = {}
    for ihb, channels in reached.items():
        full = [Module(NAMES)] * -(-channels // NAMES)
        elsewhere = full if given is None else given.of(ihb)
        tables[ihb] = decoder.table(ihb).modules or elsewhere
    if tables and not any(tables.values()):
        raise SetupError(missing(f"hub {next(iter(tables))} of {path}"))
    return tables


def _line(scan: Scan) -> str:
    return _json({"t": scan.t, "ihb": scan.ihb, "modules": scan.by_module})


def _json(value: dict[str, object]) -> str:
    return json.dumps(value, separators=(",", ":"))
