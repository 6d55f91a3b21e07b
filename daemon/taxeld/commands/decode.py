"""`taxeld decode`: a log as JSON lines, one a scan, and then what became of every frame."""

import json
import logging
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.source.logs.files import LogFile, Pass
from taxeld.source.module_order import Given, missing
from taxeld_protocol.cyskin import Command
from taxeld_protocol.decoder import Decoder, Scan, ScanDecoder
from taxeld_protocol.icub_decoder import IcubDecoder
from taxeld_protocol.modules import NAMES, Module

log = logging.getLogger(__name__)


def decode(
    path: Path, given: Given | None = None, dialect: str = "cyskin", interface: str = ""
) -> Iterator[str]:
    """The log's scans and a last line {"stats": …}; `interface`: whose frames, of several.

    The module table of a CySkin hub is what its DECLARE and DETAILS answers say, wherever in the
    log they stand; else what `given` lists; without it, full modules of twelve channels, as many as
    its packets reach. That of an iCub board is the triangles that it sends.

    Raises:
        SetupError: the log is unreadable or has no frame at all, it is not clear of which
            interface, or `given` has none of its hubs.
    """
    with LogFile(path) as log_file:
        log_file.check(interface)

        @cache  # and only for a hub that streams before it has declared its modules
        def tables() -> dict[int, Sequence[Module]]:
            return _tables(log_file, interface, given)

        known = Decoder(lambda ihb: tables().get(ihb, ()))
        decoder: ScanDecoder = IcubDecoder() if dialect == "icub" else known
        whole = Pass(log_file, decoder, interface)
        for _, scans in whole.heard():
            yield from map(_line, scans)
        yield from map(_line, decoder.flush())
        yield _json({"stats": whole.stats()})
    if whole.damage.count:
        log.warning(
            "%s: left out what is damaged or no frame (counted as %d bad_lines), at first %s",
            path, whole.damage.count, whole.damage.first,
        )  # fmt: skip


def _tables(log_file: LogFile, interface: str, given: Given | None) -> dict[int, Sequence[Module]]:
    """The module table of each hub of the log."""
    decoder = Decoder()
    reached: dict[int, int] = {}  # channels of full modules that each hub's packets run through
    for packet, _ in Pass(log_file, decoder, interface).heard():
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
        raise SetupError(missing(f"hub {next(iter(tables))} of {log_file.path}"))
    return tables


def _line(scan: Scan) -> str:
    return _json({"t": scan.t, "ihb": scan.ihb, "modules": scan.by_module})


def _json(value: dict[str, object]) -> str:
    return json.dumps(value, separators=(",", ":"))
