"""The exporter among the examples: what it writes of health, and when it takes the file away."""

import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import msgpack
import zmq

from taxeld.stream import messages

from .conftest import Sockets
from .test_stream_document import ROOT, documented

EXAMPLE = ROOT / "examples" / "metrics.py"
DEADLINE_S = 60.0
METRIC = re.compile(
    r"# HELP (?P<name>[a-z0-9_]+) (?P<path>[\w.]+) of /taxeld/health\n"
    r"# TYPE (?P=name) (?P<type>counter|gauge)\n"
    r'(?P=name)\{daemon="can0"\} (?P<value>-?[0-9.e+-]+)\n'
)


def wait(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_health_becomes_a_file_of_metrics_that_goes_when_health_does(
    sockets: Sockets, tmp_path: Path
) -> None:
    _, health = documented("/taxeld/health")
    publisher = sockets.open(zmq.XPUB)
    publisher.bind(f"ipc://{tmp_path}/stream")
    path = tmp_path / "can0.prom"
    command = [sys.executable, str(EXAMPLE), str(path), f"ipc://{tmp_path}/stream"]
    with subprocess.Popen(command) as exporter:
        try:
            assert publisher.poll(1000 * DEADLINE_S)
            assert publisher.recv() == b"\x01" + messages.HEALTH
            publisher.send_multipart([messages.HEALTH, msgpack.packb(health), b"1700000005.0"])
            wait(path.exists)
            text = path.read_text(encoding="utf-8")
            assert not path.with_suffix(".new").exists()
            wait(lambda: not path.exists())
        finally:
            exporter.terminate()
    assert METRIC.sub("", text) == ""
    found = {m["name"]: (m["path"], m["type"], float(m["value"])) for m in METRIC.finditer(text)}
    assert len(found) == text.count("# HELP"), "each name is there once"
    assert found["taxeld_loop_ticks_total"] == ("loop.ticks", "counter", 500.0)
    assert found["taxeld_uptime_seconds"] == ("uptime_s", "gauge", 5.0)
    assert found["taxeld_lat_total_p50_seconds"] == ("lat_us.total.p50", "gauge", 613 * 1e-6)
    assert found["taxeld_realtime_locked"] == ("realtime.locked", "gauge", 1.0)
    assert found["taxeld_dead_taxels"] == ("dead_taxels", "gauge", 3.0)
    assert {"taxeld_seq_total", "taxeld_t"}.isdisjoint(found)


def test_whole_numbers_that_can_fall_are_documented_keys_of_health() -> None:
    named = EXAMPLE.read_text(encoding="utf-8").split("GAUGES = {")[1].split("}")[0]
    keys, _ = documented("/taxeld/health")
    assert set(re.findall(r'"([\w.]+)"', named)) <= {key for key in keys if keys[key] == "int"}
