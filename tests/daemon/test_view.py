"""`taxeld view`: a session's and a daemon's picture, and what stops it."""

import re
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

pytest.importorskip("rerun")

from taxeld.cli import main
from taxeld.stream import messages
from taxeld.view.picture import DEAD, QUIET, colours_of, slices_of
from taxeld.view.stage import recorded
from tests.rig.commands import refused

from .conftest import Sockets
from .test_stream_document import documented
from .test_watch import maps

SESSION = Path(__file__).parent / "session"  # four contacts of a mug
CONFIG = '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
ALWAYS = (
    "/world/link /world/link/body /world/link/skin /world/object /world/object/slices /world/modes "
    "/world/radius /world/particles /status/now /status/log /plot/belief /plot/spread"
)


def entities(path: Path) -> Counter[str]:
    """Rows of each entity of an .rrd file, as Rerun's own program reads it."""
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows: Counter[str] = Counter()
    for line in printed.splitlines():
        if line.startswith("Chunk("):
            _, _, count, *rest = line.replace(") with ", " with ").split(" ")
            rows[next(word for word in rest if word.startswith("/"))] += int(count)
    return rows


def drawn(out: Path, *arguments: str) -> Counter[str]:
    """Rows of each entity that `taxeld view` draws."""
    assert main(["view", *arguments, "--save", str(out)]) == 0
    return entities(out)


def test_a_session_becomes_the_skin_the_object_the_belief_and_the_plots(tmp_path: Path) -> None:
    whole = drawn(tmp_path / "run.rrd", str(SESSION))
    assert whole.keys() >= set(ALWAYS.split())
    said = list(recorded(SESSION)[1])
    felt = [(m["z"], m["live"]) for topic, m in said if topic == messages.TAXELS]
    always = 1  # a row for what stays as it is
    changes = always + 1 + sum(a != b for a, b in pairwise(felt))
    assert whole["/world/link/skin"] == changes > 20
    topics = Counter(topic for topic, _ in said)
    assert whole["/world/particles"] == always + topics[messages.PARTICLES] > 4
    valid = sum(m["valid"] for topic, m in said if topic == messages.ESTIMATE)
    assert whole["/plot/spread"] == whole["/plot/belief"] == always + valid
    assert 2 <= whole["/status/log"] < 50, "changes alone"
    assert "/plot/error" not in whole, "nobody knows the truth of this session"
    assert whole["/plot/latency"] == always, "a replay measures no time"
    begin = drawn(tmp_path / "begin.rrd", str(SESSION), "--seconds", "2")
    assert 0 < begin["/world/link"] < whole["/world/link"] / 2


def test_where_a_session_has_the_truth_the_error_is_that_of_the_true_pose(tmp_path: Path) -> None:
    place = Path(shutil.copytree(SESSION, tmp_path / "session"))
    (place / "truth.csv").write_text("t,x,y,theta\n1,0.1,0.2,0\n", encoding="ascii")
    found = drawn(tmp_path / "run.rrd", str(place))
    assert found["/world/truth"] == 1
    assert found["/plot/error"] > 5
    stage, _ = recorded(place)
    estimate = documented("/taxeld/estimate")[1]
    estimate["map"] = {"x": 0.103, "y": 0.204, "theta": 0.0}
    assert stage.error_mm(estimate) == pytest.approx(5.0, abs=0.01)
    assert stage.error_mm(estimate | {"valid": False}) is None


@pytest.fixture
def daemon(sockets: Sockets, tmp_path: Path) -> Iterator[str]:
    """Speaks as documented, ten scans a second by its own time, until the test ends."""
    endpoint = f"ipc://{tmp_path}/stream"
    publisher: zmq.Socket[Any] = sockets.open(zmq.XPUB)
    publisher.bind(endpoint)
    said, ended = maps(), threading.Event()

    def speak() -> None:
        for number in range(100_000):
            for topic in messages.TOPICS:
                body = said[topic] | ({"t": 1e9 + 0.1 * number} if "t" in said[topic] else {})
                publisher.send_multipart([topic, msgpack.packb(body), b"0.0"])
            if ended.wait(0.01):
                return

    speaker = threading.Thread(target=speak)
    speaker.start()
    yield endpoint
    ended.set()
    speaker.join()


def test_a_running_daemon_is_shown_with_its_latencies(daemon: str, tmp_path: Path) -> None:
    found = drawn(tmp_path / "live.rrd", "--endpoint", daemon, "--seconds", "3")
    assert found.keys() >= set(ALWAYS.split())
    assert found["/plot/latency"] > 20
    config = tmp_path / "can0.toml"
    config.write_text(CONFIG + f'[publish]\nendpoints = ["{daemon}"]\n', encoding="utf-8")
    found = drawn(tmp_path / "known.rrd", str(config), "--seconds", "1")
    assert found["/world/object/slices"] == 1


def test_slices_lie_on_the_object_at_each_height_of_taxels() -> None:
    stage, _ = recorded(SESSION)
    (thing,) = stage.things
    scene, slices = thing.scene, slices_of(stage, thing)
    assert scene is not None
    assert {line[0, 2] for line in slices} == set(scene.heights)
    for line in slices:
        (k,) = np.flatnonzero(scene.heights == line[0, 2])
        at = np.round((line[:, :2] - scene.origin) / scene.cell).astype(int)
        assert np.abs(scene.slices[k][at[:, 1], at[:, 0]]).max() < 1.5 * scene.cell


def test_taxels_have_the_colour_of_their_activation() -> None:
    z, live = np.array([0.0, 0.2, 1.0, 0.5]), np.array([True, True, True, False])
    quiet, low, high, dead = colours_of(z, live).astype(int)
    assert (tuple(quiet), tuple(dead)) == (QUIET, DEAD)
    assert high.sum() > low.sum(), "the stronger is the brighter"


REFUSED = [
    ([str(SESSION)], 2, "view: no screen here; use --save FILE, or --web"),
    (["--endpoint", "ipc://{place}/none", "--save", "{out}"], 1, "no daemon answers at ipc://"),
    (["--endpoint", "foo"], 2, "--endpoint: 'foo' is no endpoint"),
    (["{place}", "--save", "{out}"], 2, "{place}: is no session"),
    (["{place}/none.toml", "--save", "{out}"], 2, "none.toml"),
    ([str(SESSION), "--save", "{place}/no/x.rrd"], 2, "--save: cannot write"),
    ([str(SESSION), "--endpoint", "ipc:///x"], 2, "are for a running daemon"),
    ([str(SESSION), "--seconds", "0", "--save", "{out}"], 2, "--seconds: must be more than 0"),
]


@pytest.mark.parametrize(("arguments", "status", "text"), REFUSED, ids=[r[2] for r in REFUSED])
def test_no_screen_no_daemon_and_wrong_arguments_are_one_line_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], status: int, text: str
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("taxeld.view.view.ANSWER_S", 0.1)
    out = tmp_path / "x.rrd"
    typed = [one.format(place=tmp_path, out=out) for one in arguments]
    assert text.format(place=tmp_path) in refused("view", *typed, status=status)
    assert not out.exists()


@pytest.mark.check
def test_the_viewer_in_a_browser_is_reached_from_this_machine_alone_and_ends() -> None:
    def listening() -> set[str]:
        """Hexadecimal addresses and ports, of the two ports of the page, that are listened at."""
        rows = [
            row.split()
            for table in ("tcp", "tcp6")
            for row in Path(f"/proc/net/{table}").read_text(encoding="ascii").splitlines()[1:]
        ]
        return {row[1] for row in rows if row[3] == "0A" and row[1].rpartition(":")[2] in ports}

    command = [sys.executable, "-m", "taxeld.cli", "view", str(SESSION), "--web"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as view:
        assert view.stdout is not None
        page = view.stdout.readline()
        ports = [f"{int(port):04X}" for port in re.findall(r"127.0.0.1:(\d+)", page)]
        assert len(ports) == 2
        assert listening() == {f"0100007F:{port}" for port in ports}
        assert view.stdout.readline() == "the session is shown\n"
        view.send_signal(signal.SIGTERM)
    assert view.returncode == 0
    assert not listening()
