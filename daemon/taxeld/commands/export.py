"""`taxeld export`: a session as files for other tools.

`frames.log` as `candump -L` writes it, `poses.csv`, `scans.csv` and `arrays.csv`, each where the
session has its like, and `modules.toml` for `source.modules` of a later listener.
"""

import csv
import io
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from taxeld.errors import SetupError
from taxeld.source import modules, session
from taxeld.source.session import Arrival, SensorPose
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.decoder import MISSING, Decoder
from taxeld_protocol.frames import Chunk, Frame, format_log_line

FRAMES, POSES, SCANS, ARRAYS = "frames.log", "poses.csv", "scans.csv", "arrays.csv"
HEADS = {
    POSES: "t_arrival,link,t,x,y,theta\n",
    SCANS: "t,link,hub,counts of its channels in their order; empty: lost\n",
    ARRAYS: "t,link,id,counts of the taxels; empty: not read\n",
}


def export(directory: Path, out: Path) -> list[Path]:
    """Write the files into `out`, anew; → their paths.

    Raises:
        SetupError: the session cannot be read, or a file is there or cannot be written.
    """
    config, (_, head) = session.config_of(directory), session.head(directory)
    files = dict[str, TextIO]()
    decoders = {
        on_it[0]: Decoder(modules.known(head.listed(source, on_it[0])), source.period_ms / 1e3)
        for source, on_it in config.buses
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
        with ExitStack() as opened:
            for arrival in session.arrivals(directory):
                for name, line in _lines(arrival, decoders):
                    if name not in files:
                        file = (out / name).open("x", encoding="utf-8")
                        files[name] = opened.enter_context(file)
                        file.write(HEADS.get(name, ""))
                    files[name].write(f"{line}\n")
        tables = {ihb: t for each in decoders.values() for ihb, t in modules.complete(each).items()}
        if tables:
            modules.write(out / modules.FILE, tables)
    except OSError as error:
        raise SetupError(f"--out: {error.filename or out} ({error.strerror})") from None
    return sorted(out / name for name in [*files, *[modules.FILE] * bool(tables)])


def _lines(arrival: Arrival, decoders: Mapping[int, Decoder]) -> Iterator[tuple[str, str]]:
    """Lines of files, by the files' names."""
    t, link, item = arrival
    match item:
        case Frame():
            yield FRAMES, format_log_line(item, f"can{link}")
        case SensorPose():
            yield POSES, _row(t, link, *item)
        case ArrayFrame():
            yield ARRAYS, _row(item.t, link, item.id, *(count or "" for count in item.counts))
    if isinstance(item, Frame | Chunk) and link in decoders:
        for _, scans in decoders[link].take([item]):
            for scan in scans:
                counts = ("" if count == MISSING else count for count in scan.counts)
                yield SCANS, _row(scan.t, link, scan.ihb, *counts)


def _row(*values: object) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(values)
    return line.getvalue()
