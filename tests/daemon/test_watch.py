"""`taxeld watch`: one page of a terminal, whatever the streams say, and nothing else."""

import contextlib
import io
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

pytest.importorskip("rich")

from rich.console import Console

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.pipeline.freshness import CURES, Why
from taxeld.stream import messages
from taxeld.view.streams import Subscriber
from taxeld.view.watch import Page
from tests.rig.commands import refused

from ..rig.processes import read_all, read_until
from .conftest import Sockets
from .test_stream_document import documented

Maps = dict[bytes, dict[str, Any]]
SKINS = (
    "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015",
    "cylinder:rows=1,columns=1,radius_m=0.04,pitch_m=0.015",
    "cylinder:rows=16,columns=10,radius_m=0.04,pitch_m=0.005",
    "wrap:modules=16,radius_m=0.06,rows=1",
)
WAIT_S = 60.0


def maps(skin: str = SKINS[0]) -> Maps:
    """One message of each topic, as documented, of a skin of which two taxels are pressed."""
    made = {topic: documented(topic.decode())[1] for topic in messages.TOPICS}
    layout = layouts.load(skin)
    info = made[messages.INFO]
    info["layout"] |= {"taxels": len(layout), "position_m": layout.position_m.tolist()}
    z = [0.0] * len(layout)
    z[0], z[-1] = 0.45, 1.0
    made[messages.TAXELS] |= {"z": z, "live": [True] * len(z)}
    return made


def shown(page: Page, now_s: float = 100.0, width: int = 80) -> list[str]:
    out = io.StringIO()
    Console(file=out, width=width, height=24, force_terminal=False).print(page.render(now_s))
    return out.getvalue().splitlines()


def page_of(said: Maps) -> Page:
    page = Page("ipc:///x")
    for topic in (messages.INFO, *messages.TOPICS):
        page.take((topic, said[topic]), 100.0)
    return page


@pytest.mark.parametrize("skin", SKINS)
def test_a_page_of_any_skin_fits_a_terminal_of_80_by_24(skin: str) -> None:
    said = maps(skin)
    said[messages.ESTIMATE]["modes"] *= 5
    lines = shown(page_of(said))
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    text = "\n".join(lines)
    assert "nan" not in text
    assert "CONVERGED" in text
    digits = sum(line[6:].count("9") for line in lines[1:9])
    assert digits >= 1, "the taxel that is pressed fully"


def test_the_map_has_a_character_a_taxel_in_the_row_of_its_height() -> None:
    said = maps()
    said[messages.TAXELS]["live"][1] = False
    rows = [line[6:] for line in shown(page_of(said))[1:6]]
    assert [row.split() for row in rows[1:4]] == [["·"] * 16] * 3
    assert rows[4].split() == ["4", "x", *["·"] * 14], "the first taxels stand lowest"
    assert rows[0].split() == [*["·"] * 15, "9"]


def test_modes_rates_latencies_and_the_age_of_the_sensor_pose_are_told() -> None:
    said = maps()
    second = {"x": -0.02, "y": 0.031, "theta": 0.5, "weight": 0.25}
    said[messages.ESTIMATE]["modes"] = [said[messages.ESTIMATE]["modes"][0], second]
    page = page_of(said)
    for number in range(60):
        page.take((messages.TAXELS, said[messages.TAXELS]), 97.0 + 0.05 * number)
    text = "\n".join(shown(page))
    assert "-20.0      31.0      28.6     25%" in text
    assert "20.3 scans/s" in text
    assert "sensor pose 8 ms old" in text
    assert ", p 99.6%" in text
    assert "radius  8.8 mm; all particles 1.0 mm, 0.9 mm, 0.5° (1 sd)" in text
    assert "3.90" in text, "what the filter took now, in milliseconds"
    assert "6 frames dropped" not in text


@pytest.mark.parametrize("why", [why for why in Why if why is not Why.VALID])
def test_the_page_has_the_whole_reason_why_an_estimate_is_not_valid(why: Why) -> None:
    said = maps()
    said[messages.ESTIMATE] |= {"valid": False, "why": int(why)}
    assert f"why not {CURES[why]}" in "\n".join(shown(page_of(said)))


def test_a_status_of_a_newer_daemon_and_taxels_of_another_skin_do_no_harm() -> None:
    said = maps()
    said[messages.ESTIMATE] |= {"status": 99, "lat_us": {}, "news": 1}
    said[messages.TAXELS]["z"] = [0.5]  # before its info
    assert "UNKNOWN" in "\n".join(shown(page_of(said)))


def test_a_page_without_messages_says_whom_it_waits_for_and_an_old_page_that_it_is_old() -> None:
    page = Page("ipc:///x")
    page.waits = "no daemon answers at ipc:///x"
    assert "waiting: no daemon answers at ipc:///x" in " ".join(shown(page))
    page = page_of(maps())
    page.waits = "no daemon answers"
    assert "nothing for 7 s: no daemon answers" in shown(page, now_s=107.0)[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"v": 1}, f"the stream is of version 1, where this taxeld reads {messages.VERSION}"),
        ({"v": None}, "is no stream of a taxeld daemon"),
        ({"v": True}, "is no stream of a taxeld daemon"),
        ({"placed": ...}, "/taxeld/taxels: has no 'placed'; use the taxeld of the daemon"),
    ],
)
def test_a_stream_of_another_version_or_program_is_refused_with_what_is_wrong(
    sockets: Sockets, tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    publisher = sockets.open(zmq.XPUB)
    publisher.bind(f"ipc://{tmp_path}/stream")
    changed = maps()[messages.TAXELS] | change
    body = msgpack.packb({key: value for key, value in changed.items() if value is not ...})
    topics = [messages.TAXELS]
    with contextlib.closing(Subscriber(f"ipc://{tmp_path}/stream", None, topics)) as streams:
        assert publisher.poll(round(1e3 * WAIT_S))
        publisher.recv()
        publisher.send_multipart([messages.TAXELS, body, b"0.0"])
        with pytest.raises(SetupError, match=said):
            list(streams.wait(WAIT_S))


VERSION_7 = {messages.INFO: maps()[messages.INFO] | {"v": 7}}
READS = f"where this taxeld reads {messages.VERSION}"
OTHER = f"the stream is of version 7, {READS}; use the taxeld of the daemon\n"


@pytest.mark.parametrize(
    ("end", "status", "line"),
    [(signal.SIGINT, 0, ""), (signal.SIGTERM, 0, ""), (None, 2, OTHER)],
    ids=["SIGINT", "SIGTERM", "another version"],
)
def test_it_waits_for_a_daemon_shows_it_and_gives_the_terminal_back(
    sockets: Sockets, tmp_path: Path, end: int | None, status: int, line: str
) -> None:
    endpoint, publisher = f"ipc://{tmp_path}/stream", sockets.open(zmq.XPUB)
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "taxeld.cli", "watch", "--endpoint", endpoint]
    size = {"TERM": "xterm", "COLUMNS": "80", "LINES": "24"}

    def say(said: Maps) -> None:
        for topic, body in said.items():
            publisher.send_multipart([topic, msgpack.packb(body), b"0.0"])

    with subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=subprocess.PIPE, env={**os.environ, **size}
    ) as process:
        os.close(theirs)
        try:
            seen = read_until(ours, "no daemon answers at")
            publisher.bind(endpoint)
            for _ in messages.TOPICS:
                assert publisher.poll(round(1e3 * WAIT_S))
                publisher.recv()
            say(maps())
            seen += read_until(ours, "CONVERGED")
            say(VERSION_7) if end is None else process.send_signal(end)
            seen += read_all(ours)
            assert process.stderr is not None
            assert process.stderr.read().decode() == line
            assert process.wait(WAIT_S) == status
        finally:
            process.kill()
    assert seen.count("\x1b[?1049h") == seen.count("\x1b[?1049l") == 1
    assert seen.rstrip().endswith(("\x1b[?25h", "\x1b[?1049l")), "the cursor is back"


def test_without_a_terminal_it_says_what_else_there_is(tmp_path: Path) -> None:
    said = refused("watch", "--endpoint", f"ipc://{tmp_path}/stream")
    assert said.startswith("watch: needs a terminal")
