"""`taxeld decode`: a log as JSON lines, one a scan, and then the fate of every frame."""

import json
import logging
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

from taxeld.config import file as config_file
from taxeld.config import gate
from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source import logs, modules, session
from taxeld.source.modules import ListedModules, missing
from taxeld_protocol.cyskin import Command, Packet
from taxeld_protocol.decoder import Decoder, Scan
from taxeld_protocol.modules import NAMES, Module

KNOWN = "candump -l and -L, and serial.bin are read"
ONE = "keep those of the skin's, as by grep ' can0 ' LOG"
HUBS_NAMED = 8  # in a line

Listed = tuple[tuple[int, ...], ...]  # as `source.modules`

log = logging.getLogger(__name__)


def of_session(path: Path) -> Listed:
    """The modules that stand beside a log in its session; none for another log. Modules that were
    declared to the recorder (`modules.toml`) go before listed ones.

    Raises:
        ConfigError: a file of the session has faults.
    """
    if path.name in (session.FRAMES, session.SERIAL):
        if (file := path.with_name(modules.FILE)).exists():
            text = f'kind = "can"\n{config_file.text_of(file)}'
            return gate.parse(SourceConfig, text, str(file)).modules
        if (config := path.with_name(session.CONFIG)).exists():
            return config_file.load(config).source.modules
    return ()


def decode(path: Path, given: ListedModules | None = None) -> Iterator[str]:
    """The log's scans and a last line {"stats": …}.

    A hub's module table comes from its DECLARE and DETAILS answers, wherever in the log they stand;
    else from `given`; else full modules are assumed, as many as the hub's packets reach, which is
    logged, and told as "assumed".

    Raises:
        SetupError: the log is unreadable or has no frame, or frames of several interfaces, or
            `given` lacks a hub. Scans before that place have been yielded.
    """
    if path.exists() and not path.is_file():
        raise SetupError(
            f"{path}: is no file; name a log, or of a session its frames.log or serial.bin"
        )

    assumed: list[int] = []

    @cache  # needed only for a hub that streams before it has declared its modules
    def tables() -> dict[int, Sequence[Module]]:
        return _tables(path, given, assumed)

    damage, decoder = logs.Damage(), Decoder(lambda ihb: tables().get(ihb, ()))
    for _, scans in _heard(path, decoder, damage):
        yield from map(_line, scans)
    yield from map(_line, decoder.flush())
    stats = {**decoder.stats(), "bad_lines": damage.count, "assumed": assumed}
    yield _json({"stats": stats})
    if damage.count:
        log.warning(
            "%s: left out what is damaged or no frame (counted as %d bad_lines), at first %s",
            path,
            damage.count,
            damage.first,
        )


def _heard(
    path: Path, decoder: Decoder, damage: logs.Damage
) -> Iterator[tuple[Packet, list[Scan]]]:
    """Packets and scans of a log."""
    names: set[str] = set()
    for name, item in logs.read(path, damage):
        names.add(name)
        if len(names - {""}) > 1:
            several = ", ".join(sorted(names - {""}))
            raise SetupError(f"{path}: has frames of several interfaces, {several}; {ONE}")
        if item is None:
            decoder.drop_foreign()
        else:
            yield from decoder.take([item])
    if not names:
        first = f" ({damage.first})" if damage.count else ""
        raise SetupError(f"{path}: has no frame{first}; {KNOWN}")
    if logs.is_serial(path) and not decoder.line.counters.packets:
        raise SetupError(f"{path}: has no packet of a hub's serial link")


def _tables(
    path: Path, given: ListedModules | None, assumed: list[int]
) -> dict[int, Sequence[Module]]:
    """The module table of each hub of the log; `assumed` is given the hubs whose table is."""
    decoder = Decoder()
    reached: dict[int, int] = {}  # hub → channels of full modules that its packets reach
    for packet, _ in _heard(path, decoder, logs.Damage()):
        if packet.command == Command.SENSOR_DATA and packet.payload:
            module, channel, values = *packet.payload[:2], len(packet.payload) // 2 - 1
            end = module * NAMES + channel + values
            reached[packet.ihb] = max(reached.get(packet.ihb, 0), end)
    tables: dict[int, Sequence[Module]] = {}
    for ihb, channels in reached.items():
        tables[ihb] = decoder.table(ihb).modules or (given.of(ihb) if given else ())
        if given is None and not tables[ihb]:
            tables[ihb] = [Module(NAMES)] * -(-channels // NAMES)
            assumed.append(ihb)
    if assumed:
        log.warning(
            "%s: has no DECLARE of hub %s; full modules of %d channels are assumed, so one cut "
            "module puts values under wrong modules; name the modules with --config CONFIG",
            path,
            ", ".join(map(str, assumed[:HUBS_NAMED])),
            NAMES,
        )
    if tables and not any(tables.values()):
        raise SetupError(missing(f"hub {next(iter(tables))} of {path}"))
    return tables


def _line(scan: Scan) -> str:
    return _json({"t": scan.t, "ihb": scan.ihb, "modules": scan.by_module})


def _json(value: dict[str, object]) -> str:
    return json.dumps(value, separators=(",", ":"))
