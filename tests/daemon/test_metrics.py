"""Metrics: what health says, as OpenMetrics text that its own grammar and a collector's take."""

import os
import re
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from taxeld.config.tables import MetricsConfig
from taxeld.errors import SetupError
from taxeld.service.metrics import MetricsFile, metrics, place, text

from .test_cli import configuration
from .test_stream_document import documented

DEADLINE_S = 60.0
NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"
LINES = re.compile(
    rf"# TYPE (?P<family>{NAME}) (?P<type>counter|gauge)\n"
    r"(?:# UNIT (?P=family) (?P<unit>[a-z]+)\n)?"
    r"# HELP (?P=family) [^\n]+\n"
    rf'(?P<sample>{NAME})\{{daemon="(?:[^"\\\n]|\\[\\"n])*"\}} (?P<value>-?[0-9.e+-]+)\n'
)


def parsed(content: str) -> dict[str, tuple[str, str, float]]:
    """Family → type, unit and value; by the part of the grammar that is used."""
    assert content.endswith("# EOF\n")
    body = content.removesuffix("# EOF\n")
    found: dict[str, tuple[str, str, float]] = {}
    at = 0
    while at < len(body):
        match = LINES.match(body, at)
        assert match is not None, body[at : at + 200]
        family, unit = match["family"], match["unit"] or ""
        assert family not in found
        assert match["sample"] == family + ("_total" if match["type"] == "counter" else "")
        assert family.endswith(unit)
        found[family] = match["type"], unit, float(match["value"])
        at = match.end()
    return found


def test_the_documented_health_is_what_the_file_says() -> None:
    _, health = documented("/taxeld/health")
    found = parsed(text(health, "can0"))
    assert found["taxeld_loop_ticks"] == ("counter", "", 500.0)
    assert found["taxeld_uptime_seconds"] == ("gauge", "seconds", 5.0)
    assert found["taxeld_lat_source_p50_seconds"] == ("gauge", "seconds", pytest.approx(168e-6))
    assert found["taxeld_realtime_switch_seconds"] == ("gauge", "seconds", 0.0005)
    assert found["taxeld_realtime_locked"] == ("gauge", "", 1.0)
    assert found["taxeld_source_pending"][0] == "gauge"
    assert found["taxeld_dead_taxels"] == ("gauge", "", 3.0)
    assert {"taxeld_v", "taxeld_seq", "taxeld_t"}.isdisjoint(found)


def test_the_daemons_name_is_quoted_and_what_is_no_number_left_out() -> None:
    health = {"loop": {"ticks": 1}, "worst": float("inf"), "lost": float("nan")}
    found = text(health, 'a"b\\c\nd')
    assert parsed(found) == {"taxeld_loop_ticks": ("counter", "", 1.0)}
    assert 'daemon="a\\"b\\\\c\\nd"' in found


def test_every_metric_names_its_key() -> None:
    _, health = documented("/taxeld/health")
    for metric in metrics(health):
        value = health
        for key in metric.path.split("."):
            value = value[key]
        assert isinstance(value, int | float | list)


def test_a_directory_that_is_missing_is_one_line(tmp_path: Path) -> None:
    assert place(MetricsConfig()) is None
    with pytest.raises(SetupError, match=r"^metrics\.file: there is no directory .*; make it$"):
        place(MetricsConfig(file=str(tmp_path / "none" / "a.prom")))


def test_a_file_that_cannot_be_written_is_said_once_and_stops_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    directory = tmp_path / "a"
    directory.mkdir()
    file = MetricsFile(directory / "skin.prom")
    directory.rmdir()
    for k in range(3):
        file.offer({"k": k})
        deadline = time.monotonic() + DEADLINE_S
        while file._health is not None:
            assert time.monotonic() < deadline
            time.sleep(0.001)
    file.close()
    assert [record.getMessage() for record in caplog.records] == [
        f"metrics.file: {directory}/skin.prom is not written (No such file or directory)"
    ]


def test_a_daemon_keeps_the_file_and_takes_it_away(tmp_path: Path) -> None:
    """It is always whole, others may read it, and with the daemon it goes."""
    path = configuration(tmp_path, "source", "kind", '"can"')
    file = tmp_path / "skin.prom"
    content = path.read_text(encoding="utf-8").replace(
        "[source]\n", '[source]\ninterface = "virtual"\nchannel = "m"\n'
    )
    path.write_text(content + f'[metrics]\nfile = "{file}"\n', encoding="utf-8")
    old = os.umask(0o077)
    command = [sys.executable, "-m", "taxeld.cli", "run", str(path)]
    ticks: set[float] = set()
    with subprocess.Popen(command) as daemon:
        try:
            os.umask(old)
            deadline = time.monotonic() + DEADLINE_S
            while len(ticks) < 2:
                assert time.monotonic() < deadline
                assert daemon.poll() is None
                if file.exists():
                    found = parsed(file.read_text(encoding="utf-8"))
                    ticks.add(found["taxeld_loop_ticks"][2])
                    assert stat.S_IMODE(file.stat().st_mode) == 0o644
                time.sleep(0.01)
            daemon.terminate()
            assert daemon.wait(DEADLINE_S) == 0
        finally:
            daemon.kill()
    assert not list(tmp_path.glob("skin.prom*"))


def test_codes_and_numbers_of_now_are_gauges_not_counters() -> None:
    health = documented("/taxeld/health")[1]
    counters = {metric.path for metric in metrics(health) if metric.counts}
    now = {"inputs.poses_fault", "inputs.poses_other_topics", "modules.layout", "modules.foreign"}
    assert not counters & now
    assert "inputs.poses_received" in counters
