"""Write /taxeld/health to a file for the textfile collector of Prometheus' node_exporter.

    python metrics.py /var/lib/prometheus/node-exporter/taxeld_can0.prom ipc:///run/taxeld/stream

The file goes when no health comes. Times are in seconds, and of a list its length is given.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import zmq

SILENT_MS = 5_000  # without health: the daemon has ended, or cannot be reached
UNITS = {"_us": 1e-6, "_s": 1.0}  # ends of keys whose values are times, in seconds
GAUGES = {  # whole numbers that can fall; all others count since the start
    *("inputs.scans_waiting", "realtime.fifo", "modules.layout", "modules.foreign"),
}


def values(part: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in part.items():
        if isinstance(value, dict):
            yield from values(value, f"{path}{key}.")
        elif not isinstance(value, str) and (path or key not in ("v", "seq", "t")):
            yield path + key, value


def text(health: dict[str, Any], daemon: str) -> str:
    lines = []
    for path, value in values(health):
        parts = path.split(".")
        unit = next((u for u in UNITS if any(part.endswith(u) for part in parts)), "")
        kind = "gauge" if unit or type(value) is not int or path in GAUGES else "counter"
        name = "_".join(["taxeld", *(part.removesuffix(unit) for part in parts)])
        name += "_seconds" * bool(unit) + "_total" * (kind == "counter")
        number = (len(value) if isinstance(value, list) else value) * UNITS.get(unit, 1.0)
        lines.append(f"# HELP {name} {path} of /taxeld/health\n# TYPE {name} {kind}\n")
        lines.append(f'{name}{{daemon="{daemon}"}} {number}\n')
    return "".join(lines)


if len(sys.argv) < 2 or not Path(sys.argv[1]).parent.is_dir():
    sys.exit(f"name a file in a directory that is there\n{__doc__}")
path = Path(sys.argv[1])
beside = path.with_suffix(".new")  # the collector reads *.prom alone
socket = zmq.Context().socket(zmq.SUB)
socket.connect(sys.argv[2] if len(sys.argv) > 2 else "ipc:///run/taxeld/stream")
socket.setsockopt(zmq.SUBSCRIBE, b"/taxeld/health")
while True:
    if socket.poll(SILENT_MS):
        _topic, body, *_time = socket.recv_multipart()
        beside.write_text(text(msgpack.unpackb(body), path.stem), encoding="utf-8")
        beside.replace(path)
    else:
        path.unlink(missing_ok=True)
