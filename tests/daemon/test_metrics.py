"""The exporter among the examples: what it writes of health, and when it takes the file away."""

import re
import subprocess
import sys
from pathlib import Path

import msgpack
import pytest
import zmq

from taxeld.stream import topics

from ..rig.clocks import PATIENCE_S, until
from ..rig.sockets import Sockets
from ..rig.stream_page import ROOT, documented

EXAMPLE = ROOT / "examples" / "metrics.py"
METRIC = re.compile(
    r"# HELP (?P<name>[a-z0-9_]+) (?P<path>[\w.]+) of /taxeld/health\n"
    r"# TYPE (?P=name) (?P<type>counter|gauge)\n"
    r'(?P=name)\{daemon="can0"\} (?P<value>-?[0-9.e+-]+)\n'
)


@pytest.mark.check
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
            assert publisher.poll(1000 * PATIENCE_S)
            assert publisher.recv() == b"\x01" + topics.HEALTH
            publisher.send_multipart([topics.HEALTH, msgpack.packb(health), b"1700000005.0"])
            until(path.exists)
            text = path.read_text(encoding="utf-8")
            assert not path.with_suffix(".new").exists()
            until(lambda: not path.exists())
        finally:
            exporter.terminate()
    assert METRIC.sub("", text) == ""
    found = {m["name"]: (m["path"], m["type"], float(m["value"])) for m in METRIC.finditer(text)}
    assert len(found) == text.count("# HELP"), "each name is there once"
    assert found["taxeld_source_scans_total"] == ("source.scans", "counter", 99.0)
    assert found["taxeld_uptime_seconds"] == ("uptime_s", "gauge", 5.0)
    assert found["taxeld_lat_total_p50_seconds"] == ("lat_us.total.p50", "gauge", 613 * 1e-6)
    assert found["taxeld_realtime_locked"] == ("realtime.locked", "gauge", 1.0)
    assert found["taxeld_dead_taxels"] == ("dead_taxels", "gauge", 3.0)
    assert {"taxeld_seq_total", "taxeld_t"}.isdisjoint(found)
