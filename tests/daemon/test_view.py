"""`taxeld view`: a session's and a daemon's picture, and what stops it."""

import re
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import msgpack
import numpy as np
import pytest
import zmq

pytest.importorskip("rerun")

import rerun as rr

from taxeld.cli import main
from taxeld.stream import topics
from taxeld.view import view
from tests.rig.commands import refused
from tests.rig.configurations import configuration
from tests.rig.recorded import write_session
from tests.rig.skins import SKIN
from tests.rig.stream_page import documented

from .conftest import Sockets

SESSION = Path(__file__).parent / "session"  # four contacts of a mug
TOPICS = topics.INFO, topics.TAXELS, topics.ESTIMATE, topics.PARTICLES
ALWAYS = {
    "/world/link",
    "/world/link/skin",
    "/world/object",
    "/world/modes",
    "/world/particles",
    "/status",
    "/plot/belief/p",
    "/plot/spread/theta_deg",
}
WAIT_MS = 60_000
Maps = dict[bytes, dict[str, Any]]


def entities(path: Path) -> Counter[str]:
    """Rows of each entity of an .rrd file, as Rerun's own program reads it."""
    command = [sys.executable, "-m", "rerun_cli", "rrd", "print", str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows: Counter[str] = Counter()
    for count, name in re.findall(
        r"^Chunk\(\w+\) with +(\d+) rows .*? (/\S+)", printed, re.MULTILINE
    ):
        rows[name] += int(count)
    return rows


def drawn(out: Path, *arguments: str) -> Counter[str]:
    """Rows of each entity that `taxeld view` draws."""
    assert main(["view", *arguments, "--save", str(out)]) == 0
    return entities(out)


def test_a_session_becomes_the_skin_the_object_the_belief_and_the_plots(tmp_path: Path) -> None:
    """With the truth also the true pose and the error."""
    place = Path(shutil.copytree(SESSION, tmp_path / "session"))
    (place / "truth.csv").write_text("t,x,y,theta\n1,0.1,0.2,0\n", encoding="ascii")
    whole = drawn(tmp_path / "run.rrd", str(place))
    assert whole.keys() >= ALWAYS
    said = list(view.recorded(SESSION)[1])
    sent = Counter(topic for topic, _ in said)
    assert whole["/world/link/skin"] == sent[topics.TAXELS] > 20
    assert whole["/world/particles"] == sent[topics.PARTICLES] > 4
    valid = sum(m["valid"] for topic, m in said if topic == topics.ESTIMATE)
    plots = "/plot/belief/p", "/plot/spread/x_mm", "/plot/error/add_mm"
    assert ([whole[name] for name in plots], whole["/world/truth"]) == ([valid] * 3, 1)
    begin = drawn(tmp_path / "begin.rrd", str(SESSION), "--seconds", "2")
    assert 0 < begin["/world/link"] < whole["/world/link"] / 2
    assert "/plot/error/add_mm" not in begin, "nobody knows the truth of this session"


def test_a_session_without_an_object_is_the_skin_alone(tmp_path: Path) -> None:
    write_session(tmp_path)
    configuration(tmp_path, scene={})
    found = drawn(tmp_path / "run.rrd", str(tmp_path)).keys()
    assert found & {"/world/link/skin", "/world/object", "/status"} == {"/world/link/skin"}


def maps() -> Maps:
    """A message of each topic that is drawn, as documented, of a skin with two pressed taxels."""
    made = {topic: documented(topic.decode())[1] for topic in TOPICS}
    z = [0.45, *[0.0] * (len(SKIN) - 2), 1.0]
    made[topics.INFO]["layout"] |= {"position_m": SKIN.position_m.tolist()}
    made[topics.TAXELS] |= {"z": z, "live": [True] * len(z)}
    return made


def restarted(number: int, said: Maps) -> Maps:
    """The same daemon, and from the tenth scan on one that knows a second object and has another
    skin; its info comes ten scans late."""
    if number >= 10:
        for one in (said[topics.ESTIMATE], *said[topics.ESTIMATE]["modes"]):
            one["object"] = 1
        said[topics.TAXELS] |= {"z": [0.5], "live": [True]}
        said[topics.INFO]["objects"] = said[topics.INFO]["objects"][:1] * 2
        said[topics.INFO]["layout"]["position_m"] = [[0.04, 0.0, 0.0]]
    return said if number in (0, 20) else {topic: said[topic] for topic in TOPICS[1:]}


@pytest.fixture
def daemon(sockets: Sockets, tmp_path: Path) -> Iterator[Callable[..., str]]:
    """Starts a daemon that speaks as documented once a subscriber has come, ten scans a second by
    its own time, until the test ends; → its endpoint."""
    publisher, endpoint, ended = sockets.open(zmq.XPUB), f"ipc://{tmp_path}/stream", Event()
    publisher.setsockopt(zmq.RCVTIMEO, WAIT_MS)
    publisher.bind(endpoint)

    def speak(said_of: Callable[[int, Maps], Maps]) -> None:
        for _ in TOPICS:
            publisher.recv()
        for number in range(100_000):
            for topic, said in said_of(number, maps()).items():
                body = said | ({"t": 1e9 + 0.1 * number} if "t" in said else {})
                publisher.send_multipart([topic, msgpack.packb(body), b"0.0"])
            if ended.wait(0.01):
                return

    with ThreadPoolExecutor(1) as pool:
        yield lambda said_of=lambda _, said: said: pool.submit(speak, said_of) and endpoint
        ended.set()


def test_a_running_daemon_is_shown(daemon: Callable[..., str], tmp_path: Path) -> None:
    config = tmp_path / "can0.toml"
    told = f'[source]\nkind = "can"\nchannel = "can0"\n[publish]\nendpoints = ["{daemon()}"]\n'
    config.write_text(told, encoding="utf-8")
    found = drawn(tmp_path / "live.rrd", str(config), "--seconds", "3")
    assert found.keys() >= ALWAYS
    assert found["/plot/belief/p"] > 20


def test_a_daemon_that_is_restarted_with_more_objects_is_drawn_from_its_info_on(
    daemon: Callable[..., str], tmp_path: Path
) -> None:
    found = drawn(tmp_path / "x.rrd", daemon(restarted), "--seconds", "2.95")
    assert found["/world/object"] == found["/world/link/skin"] == 20


REFUSED = [
    ([str(SESSION)], 2, "view: no screen here; use --save FILE"),
    (["ipc://{place}/none", "--save", "{out}"], 1, "no daemon answers at ipc://"),
    ([str(SESSION), "--save", "{place}/no/x.rrd"], 2, "--save: cannot write"),
    ([str(SESSION), "--seconds", "0", "--save", "{out}"], 2, "--seconds: must be more than 0"),
]


@pytest.mark.parametrize(("arguments", "status", "text"), REFUSED, ids=[r[2] for r in REFUSED])
def test_no_screen_no_daemon_and_wrong_arguments_are_one_line_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], status: int, text: str
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("taxeld.view.view.ANSWER_S", 0.1)
    typed = [one.format(place=tmp_path, out=tmp_path / "x.rrd") for one in arguments]
    assert text in refused("view", *typed, status=status)
    assert not (tmp_path / "x.rrd").exists()


@pytest.fixture
def viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], object]:
    """Makes a shell script the viewer; its directory is the test's."""
    path = tmp_path / "viewer"
    path.touch(mode=0o755)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(view, "VIEWER", str(path))
    return lambda script: path.write_text(f"#!/bin/sh\ncd {tmp_path}\n{script}\n", "ascii")


def test_a_window_gets_all_and_no_other_machine_reaches_it(
    viewer: Callable[[str], object], tmp_path: Path
) -> None:
    viewer("echo $@ >options; cat >seen.rrd")
    assert main(["view", str(SESSION)]) == 0
    assert entities(tmp_path / "seen.rrd").keys() >= ALWAYS
    assert "--bind=127.0.0.1" in (tmp_path / "options").read_text(encoding="ascii").split()


def test_a_window_that_is_closed_ends_the_view_of_a_daemon(
    viewer: Callable[[str], object], daemon: Callable[..., str], tmp_path: Path
) -> None:
    viewer("head -c 20000 >seen")
    assert main(["view", daemon()]) == 0
    assert (tmp_path / "seen").stat().st_size == 20_000


def test_a_window_that_is_closed_leaves_the_rest_undrawn(viewer: Callable[[str], object]) -> None:
    """The stream's own end would wait for it while it holds the interpreter."""
    viewer("exit 0")
    picture, much = view.Picture(), rr.Points3D(np.zeros((200, 3)))
    logged = ([picture.stream.log("much", much) for _ in range(30)] for _ in range(50))
    view.show(picture, (view.PAUSE for _ in logged), lambda: False)


def test_a_viewer_that_fails_is_one_line(viewer: Callable[[str], object]) -> None:
    viewer("exit 1")
    assert refused("view", SESSION).startswith("view: the viewer failed")
