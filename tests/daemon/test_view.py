"""`taxeld view`: what it writes of a session and of a daemon, and what stops it."""

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

from rerun.time import to_nanos_since_epoch

from taxeld.cli import main
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.view import viewer
from taxeld.view.colour import DEAD, QUIET, of_taxels
from taxeld.view.recorded import Recording
from taxeld.view.space import Space
from taxeld.view.stage import Message, Stage, check_version, from_config, from_info, pose_of
from taxeld.view.view import _together

from .conftest import Sockets
from .test_stream_document import documented
from .test_watch import maps

SESSION = Path(__file__).parent / "session"  # four contacts of a mug
WAIT_S = 60.0
STAYS = {"/world/link/body", "/world/object/slices"}
ALWAYS = {
    "/world/link", "/world/link/body", "/world/link/skin", "/world/link/pressed",
    "/world/object", "/world/object/slices", "/world/modes", "/world/particles",
    "/status/now", "/status/log",
    "/plot/belief/heaviest", "/plot/spread/x_mm", "/plot/spread/yaw_deg",
}  # fmt: skip


def entities(path: Path) -> Counter[str]:
    """Rows of each entity of an .rrd file, as Rerun's own program reads it."""
    command = [viewer._program(), "rrd", "print", str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    rows: Counter[str] = Counter()
    for line in printed.splitlines():
        if line.startswith("Chunk("):
            _, _, count, *rest = line.replace(") with ", " with ").split(" ")
            rows[next(word for word in rest if word.startswith("/"))] += int(count)
    return rows


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Counter[str]:
    out = tmp_path_factory.mktemp("view") / "run.rrd"
    assert main(["view", str(SESSION), "--save", str(out)]) == 0
    return entities(out)


def test_a_session_becomes_the_skin_the_object_the_belief_and_the_plots(
    whole: Counter[str],
) -> None:
    assert whole.keys() >= ALWAYS
    said = list(Recording(SESSION))
    felt = [(m["z"], m["live"]) for topic, m in said if topic == messages.TAXELS]
    always = 1  # a row for what stays as it is
    changes = always + 1 + sum(a != b for a, b in pairwise(felt))
    assert whole["/world/link/skin"] == changes > 20
    topics = Counter(topic for topic, _ in said)
    assert whole["/world/particles"] == always + topics[messages.PARTICLES] > 4
    assert whole["/plot/spread/x_mm"] == always + sum(
        m["valid"] for topic, m in said if topic == messages.ESTIMATE
    )
    assert 2 <= whole["/status/log"] < 50, "changes alone"
    assert "/plot/error/add_mm" not in whole, "nobody knows the truth of this session"
    assert "/plot/latency/total" not in whole or whole["/plot/latency/total"] == 1


def test_the_first_seconds_of_a_session_are_fewer(tmp_path: Path, whole: Counter[str]) -> None:
    out = tmp_path / "begin.rrd"
    assert main(["view", str(SESSION), "--save", str(out), "--seconds", "2"]) == 0
    assert 0 < entities(out)["/world/link"] < whole["/world/link"] / 2


class Drawn:
    """In place of Rerun's stream: the rows of each entity, a time and the values of components."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[int, dict[str, Any]]]] = {}
        self._t_ns = 0

    def send_blueprint(self, _: object) -> None: ...

    def set_time(self, _: str, timestamp: float) -> None:
        self._t_ns = to_nanos_since_epoch(timestamp)

    def log(self, entity: str, thing: Any, static: bool = False) -> None:
        values = {
            batch.component_descriptor().component: batch.as_arrow_array().to_pylist()
            for batch in thing.as_component_batches()
        }
        if not static:
            self.rows.setdefault(entity, []).append((self._t_ns, values))

    def send_columns(self, entity: str, indexes: list[Any], columns: list[Any]) -> None:
        (times,) = (index.as_arrow_array().cast("int64").to_pylist() for index in indexes)
        named = {
            column.component_descriptor().component: column.as_arrow_array().to_pylist()
            for column in columns
        }
        for k, t_ns in enumerate(times):
            values = {name: column[k] for name, column in named.items()}
            self.rows.setdefault(entity, []).append((t_ns, values))


def test_rows_that_waited_for_each_other_are_those_that_are_sent_at_once() -> None:
    """Of a session they go together; of a daemon, each goes at once."""
    recording = Recording(SESSION)
    said = list(recording)
    at_once, together = Drawn(), Drawn()
    for stream, is_live in ((at_once, True), (together, False)):
        space = Space(recording.stage, stream, is_live=is_live)  # type: ignore[arg-type]
        for number, message in enumerate(said):
            space.take(message)
            if number % 100 == 0:
                space.flush()
        space.flush()
    assert (
        at_once.rows.keys()
        == together.rows.keys()
        >= {entity.removeprefix("/") for entity in ALWAYS - STAYS}
    )
    for entity, rows in at_once.rows.items():
        assert together.rows[entity] == rows, entity


def test_a_session_is_drawn_while_it_is_replayed(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, replayed = [0.0], []

    def replay() -> Iterator[Message]:
        for seq in range(1000):
            now_s[0] += 0.01
            replayed.append(seq)
            yield messages.ESTIMATE, {"seq": seq}

    monkeypatch.setattr("taxeld.view.view.time.monotonic", lambda: now_s[0])
    looks = _together(replay())
    first = next(looks)
    assert len(first) == len(replayed) < 100
    assert [m["seq"] for look in (first, *looks) for _, m in look] == list(range(1000))


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
    out = tmp_path / "live.rrd"
    assert main(["view", "--endpoint", daemon, "--save", str(out), "--seconds", "3"]) == 0
    found = entities(out)
    assert found.keys() >= ALWAYS
    assert found["/plot/latency/total"] > 20
    assert found["/world/object/slices"] == 1


def test_with_a_configuration_and_the_truth_the_error_is_shown(daemon: str, tmp_path: Path) -> None:
    config, out = tmp_path / "can0.toml", tmp_path / "live.rrd"
    config.write_text(
        '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
        f'[publish]\nendpoints = ["{daemon}"]\n', encoding="utf-8",
    )  # fmt: skip
    arguments = ["--truth", "0.1", "0", "0.5", "--save", str(out), "--seconds", "1"]
    assert main(["view", str(config), *arguments]) == 0
    found = entities(out)
    assert found["/plot/error/add_mm"] > 5
    assert found["/world/truth"] == 1


def test_the_error_is_that_of_the_true_pose_and_none_without_it() -> None:
    stage = from_config(load(SESSION / "config.toml"), np.array([0.1, 0.2, 0.0]))
    estimate = documented("/taxeld/estimate")[1]
    estimate["map"] = {"x": 0.103, "y": 0.204, "theta": 0.0}
    assert stage.error_mm(estimate) == pytest.approx(5.0, abs=0.01)
    assert stage.error_mm(estimate | {"valid": False}) is None
    assert from_config(load(SESSION / "config.toml")).error_mm(estimate) is None


def test_slices_lie_on_the_object_at_each_height_of_taxels() -> None:
    stage = Recording(SESSION).stage
    scene = stage.scene
    assert scene is not None
    assert {height for height, _ in stage.slices} == set(scene.heights)
    for height, line in stage.slices:
        (k,) = np.flatnonzero(scene.heights == height)
        at = np.round((line - scene.origin) / scene.cell).astype(int)
        assert np.abs(scene.slices[k][at[:, 1], at[:, 0]]).max() < 1.5 * scene.cell


def test_what_a_daemon_says_of_itself_is_what_is_drawn() -> None:
    stage = from_info(maps()[messages.INFO])
    assert stage.object == "003_cracker_box"
    assert stage.position_m.shape == (80, 3)
    assert stage.name("status", 3) == "converged"
    assert stage.name("status", 77) == "unknown"
    assert [round(height, 3) for height, _ in stage.slices] == [-0.03, 0.03]
    for _, line in stage.slices:
        np.testing.assert_array_equal(line[0], line[-1])


@pytest.mark.parametrize("key", ["layout", "outline", "object", "status"])
def test_an_info_that_lacks_something_is_refused(key: str) -> None:
    info = maps()[messages.INFO]
    del info[key]
    with pytest.raises(SetupError, match="/taxeld/info: is not what a taxeld daemon sends"):
        from_info(info)


@pytest.mark.parametrize("version", [None, "1", 1.0, True])
def test_a_stream_without_a_version_is_another_programs(version: object) -> None:
    """And not one of the version None."""
    with pytest.raises(SetupError, match="is no stream of a taxeld daemon"):
        check_version({"v": version})


def test_taxels_have_the_colour_of_their_activation() -> None:
    z, live = np.array([0.0, 0.2, 1.0, 0.5]), np.array([True, True, True, False])
    quiet, low, high, dead = of_taxels(z, live).astype(int)
    assert tuple(quiet) == QUIET
    assert tuple(dead) == DEAD
    assert high.sum() > low.sum(), "the stronger is the brighter"


def test_the_pose_of_a_message_is_its_x_y_and_yaw() -> None:
    assert pose_of({"theta": 3.0, "y": 2.0, "x": 1.0}).tolist() == [1.0, 2.0, 3.0]


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    status = main(["view", *arguments])
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return status, said


def test_no_screen_no_daemon_and_wrong_arguments_are_one_line_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("taxeld.view.view.ANSWER_S", 0.1)
    out, nobody = str(tmp_path / "x.rrd"), f"ipc://{tmp_path}/none"
    for arguments, status, text in (
        ([str(SESSION)], 2, "view: no screen here; use --save FILE, or --web"),
        (["--endpoint", nobody, "--save", out], 1, f"no daemon answers at {nobody}"),
        (["--endpoint", "foo"], 2, "--endpoint: 'foo' is no endpoint"),
        ([str(tmp_path), "--save", out], 2, f"{tmp_path}: is no session"),
        ([str(tmp_path / "none"), "--save", out], 2, "is no session"),
        ([str(tmp_path / "none.toml"), "--save", out], 2, "none.toml"),
        ([str(SESSION), "--save", str(tmp_path / "no" / "x.rrd")], 2, "--save: cannot write"),
        ([str(SESSION), "--truth", "0", "0", "0"], 2, "are for a running daemon"),
        (["--truth", "0", "0", "0"], 2, "--truth: needs CONFIG"),
        ([str(SESSION), "--seconds", "0", "--save", out], 2, "--seconds: must be more than 0"),
    ):
        got, said = refused(arguments, capsys)
        assert (got, text in said) == (status, True), said
    assert not Path(out).exists()


def test_a_daemon_of_another_version_is_one_line(
    sockets: Sockets, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    publisher: zmq.Socket[Any] = sockets.open(zmq.XPUB)
    publisher.bind(f"ipc://{tmp_path}/stream")
    info = maps()[messages.INFO] | {"v": 2}

    def answer() -> None:
        if publisher.poll(round(1e3 * WAIT_S)):
            publisher.recv()
            publisher.send_multipart([messages.INFO, msgpack.packb(info), b"0.0"])

    thread = threading.Thread(target=answer)
    thread.start()
    status, said = refused(["--endpoint", f"ipc://{tmp_path}/stream", "--save", "/x"], capsys)
    thread.join()
    assert status == 2
    assert said.startswith("the stream is of version 2, where this taxeld reads 1")


def test_the_daemon_loads_nothing_of_the_view() -> None:
    code = (
        "import sys, taxeld.service.loop, taxeld.commands.relay\n"
        "print(*(m for m in sys.modules if m.startswith(('taxeld.view', 'rich', 'rerun'))))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.split() == []


def test_the_viewer_in_a_browser_is_reached_from_this_machine_alone() -> None:
    """And ends with what started it."""
    with viewer.start(web=True) as started:
        addresses = listening(started.process.pid)
        assert len(addresses) >= 2
        assert {host for host, _ in addresses} == {"0100007F"}, "127.0.0.1 as the kernel writes it"
        assert started.page.startswith("http://127.0.0.1:")
    assert started.is_gone


def listening(pid: int) -> set[tuple[str, str]]:
    """Host and port of the TCP sockets at which a process listens."""
    links = [p.readlink().name for p in Path(f"/proc/{pid}/fd").iterdir() if p.is_symlink()]
    inodes = {link.split("[")[1].rstrip("]") for link in links if link.startswith("socket:[")}
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text(encoding="ascii").splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                host, port = fields[1].split(":")
                found.add((host, port))
    return found


def test_a_stage_of_other_taxels_than_the_daemons_is_refused(
    daemon: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def other(*_: object) -> Stage:
        found = from_info(maps()[messages.INFO])
        return Stage(found.object, "x", found.position_m[:5], 0.04, found.slices)

    config = tmp_path / "can0.toml"
    config.write_text('[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n',
                      encoding="utf-8")  # fmt: skip
    monkeypatch.setattr("taxeld.view.stage.from_config", other)
    arguments = [str(config), "--endpoint", daemon, "--save", str(tmp_path / "x.rrd")]
    status, said = refused(arguments, capsys)
    assert status == 2
    assert "has 80 taxels, that of the configuration 5" in said
