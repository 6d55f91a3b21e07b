"""`source.kind = "array"`: a daemon finds a box by arrays alone, and a recording replays."""

import json
import re
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from taxeld.config.file import load
from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.estimator.estimate import Status
from taxeld.layout import read as layouts
from taxeld.layout.generated import Cylinder
from taxeld.layout.read import MAX_TAXELS
from taxeld.proposals import manifest
from taxeld.service.prepare import prepared
from taxeld.skin.patches import Patches
from taxeld.skin.skin import Skin
from taxeld.source.sources import ArraySource
from taxeld_protocol.array import FULL, REST, ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Scan
from tests.rig.array_skin import LAYOUT, ArraySkin, bound
from tests.rig.clocks import until
from tests.rig.configurations import configuration
from tests.rig.pressed_box import TRUTH
from tests.rig.processes import free_port, replayed, taxeld
from tests.rig.scenes import disc, scene_of
from tests.rig.sessions import items_of
from tests.rig.skins import SKIN, table_of
from tests.rig.sockets import Sockets

UIDS = SKIN.uid.tolist()


def daemon_of(place: Path, endpoint: str, robot: str) -> Path:
    return configuration(
        place,
        skin={"layout": LAYOUT},
        source={"kind": "array", "endpoint": endpoint, "array": "arm"},
        sensor_pose={"endpoint": robot},
    )


def test_the_box_is_found_by_arrays_and_again_in_the_replay(tmp_path: Path) -> None:
    endpoint, robot = f"ipc://{tmp_path}/skin", f"tcp://127.0.0.1:{free_port()}"
    config, recorded = daemon_of(tmp_path, endpoint, robot), tmp_path / "session"
    with (
        Sockets() as sockets,
        ArraySkin(endpoint, robot, "counts"),
        taxeld("run", "--record", recorded, config) as daemon,
    ):
        socket = sockets.subscriber(f"ipc://{tmp_path}/stream", b"/taxeld/estimate")

        def found() -> bool:
            assert daemon.poll() is None
            if not socket.poll(20):
                return False
            e = msgpack.unpackb(socket.recv_multipart()[1])
            near = abs(e["map"]["x"] - TRUTH[0]) + abs(e["map"]["y"] - TRUTH[1]) < 0.01
            return near and e["status"] == Status.CONVERGED and e["contacts"] >= 8

        until(found)
        daemon.terminate()
    assert daemon.returncode == 0
    estimates = [json.loads(line) for line in replayed(recorded).splitlines()]
    assert any(e["status"] == Status.CONVERGED for e in estimates)
    assert isinstance(items_of(recorded)[0], ArrayFrame)


def frames(count: int, rest: int = REST) -> list[ArrayFrame]:
    """Frames of 20 Hz, each with a taxel that was not read."""
    rng = np.random.default_rng(1)
    found = []
    for i in range(count):
        counts = (rest + rng.integers(1, FULL, len(UIDS))).tolist()
        counts[i % len(counts)] = 0
        found.append(ArrayFrame(1e9 + i / 20.0, "arm", rest, tuple(counts)))
    return found


def scans(items: list[ArrayFrame], uids: Sequence[int] = UIDS) -> list[Scan]:
    decoder = ArrayDecoder(uids)
    return [scan for item in items for scan in decoder.feed(item)[1]]


def test_activations_are_the_senders_from_the_first_scan_on_whatever_the_order_of_the_uids() -> (
    None
):
    order = np.random.default_rng(2).permutation(len(SKIN))
    skin = Skin(replace(SKIN, uid=order.astype(np.int64)), SkinConfig())  # 0, 12, 15 …
    z = np.linspace(0.1, 1.0, len(SKIN))
    counts = tuple(REST + round(v * FULL) for v in z)
    sent = [ArrayFrame(1e9 + i, "", REST, counts) for i in range(300)]
    for number, scan in enumerate(scans(sent, order.tolist())):
        if number == 299:
            skin.tare()
        activation = skin.on_scan(scan)
        np.testing.assert_allclose(activation.z, z, atol=1e-4)  # no drift takes a long press away
        assert activation.live.all()
    assert not skin.wiring.lacking


def test_counts_are_learned_at_rest_as_those_of_a_bus() -> None:
    skin = Skin(SKIN, SkinConfig())
    rng = np.random.default_rng(0)
    made = []
    for i in range(40):
        counts = 5000 + rng.normal(0.0, 10.0, len(SKIN))
        counts[3] += 10_000.0 * (i == 39)
        made.append(ArrayFrame(1e9 + i / 20.0, "", 0, tuple(map(int, counts))))
    found = [skin.on_scan(scan) for scan in scans(made)]
    assert found[:18] == [None] * 18
    assert found[-1].z.argmax() == 3
    assert found[-1].z[3] == pytest.approx(0.5, abs=0.01)


def test_each_kind_of_bad_input_is_logged_once_and_costs_no_scan(
    caplog: pytest.LogCaptureFixture,
) -> None:
    source = ArraySource(SourceConfig(kind="array", endpoint="tcp://127.0.0.1:9"), {0: SKIN})
    good = frames(60)
    came = []
    for number, frame in enumerate(good):
        later = frame._replace(t=frame.t + 0.01)
        for strange in (
            later._replace(id="leg"),
            later._replace(counts=frame.counts[1:]),
            later._replace(rest=0),
            frame,  # once more
        ):
            source.hear(frame)
            source.hear(strange)
        source.heed(connected=True, malformed=number, reason="t is no Unix time in seconds")
        came += source.poll(number / 20.0)
    assert [scan.t for scan in came] == [frame.t for frame in good]
    assert source.decoder.stats()["dropped"] == {
        **dict.fromkeys(("length_errors", "foreign", "mixed"), 60),
        "disordered": 4 * 60,
    }
    assert len(caplog.messages) == len(set(caplog.messages)) == 5


@pytest.mark.parametrize(
    ("connected", "reason", "words"),
    [
        (False, "", "source.endpoint: nobody sends to ipc:///skin"),
        (True, "", "source.endpoint: no array comes by ipc:///skin"),
        (True, "z is no list", "source.endpoint: no array comes by ipc:///skin (the last was none"),
    ],
)
def test_a_source_without_arrays_says_why(connected: bool, reason: str, words: str) -> None:
    source = ArraySource(SourceConfig(kind="array", endpoint="ipc:///skin"), {0: SKIN})
    source.heed(connected=connected, malformed=0, reason=reason)
    source.poll(0.0)
    assert not source.waits_for
    source.poll(2.0)
    assert source.waits_for.startswith(words)


COLUMNS = 200
PAIRS_BYTES = 8 * MAX_TAXELS**2  # 200 MB
MOST_BYTES = 300e6  # of a daemon, with Python and all libraries


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Of a daemon on an array of as many taxels, and a disc."""
    made = Cylinder(MAX_TAXELS // COLUMNS, COLUMNS, 0.2, 0.006).layout("many")
    (tmp_path / "many.csv").write_text(table_of(made, uid=True), encoding="ascii")
    skin = layouts.load(str(tmp_path / "many.csv"))
    manifest.save_scene(scene_of(disc(0.05), skin, symmetry=0), tmp_path / manifest.SCENE)
    about = {
        "format": manifest.FORMAT,
        "object": "disc",
        "layout": {"name": "many", "digest": skin.digest},
        "files": {manifest.SCENE: manifest.digest((tmp_path / manifest.SCENE).read_bytes())},
        "samplers": [],
        "auto": [],
        "height_m": 0.0,
        "depth_max_m": 0.005,
    }
    (tmp_path / manifest.NAME).write_text(json.dumps(about), encoding="utf-8")
    return configuration(
        tmp_path,
        skin={"layout": tmp_path / "many.csv"},
        scene={"bundle": tmp_path},
        source={"kind": "array", "endpoint": f"ipc://{tmp_path}/skin"},
    )


def test_a_start_allocates_nothing_of_the_size_of_all_pairs(config: Path) -> None:
    tracemalloc.start()
    (skin,) = prepared(load(config), 0.0).layouts
    assert len(Patches(skin, 0.005).layout) == MAX_TAXELS
    assert tracemalloc.get_traced_memory()[1] < 0.75 * PAIRS_BYTES
    tracemalloc.stop()


def test_a_daemon_starts_and_feels_contacts_in_300_mb(config: Path, sockets: Sockets) -> None:
    place, sent = config.parent, count()
    sender = sockets.keep(bound(sockets.context, f"ipc://{place}/skin"))
    heard = sockets.subscriber(f"ipc://{place}/stream", b"/taxeld/estimate")

    def has_felt() -> Any:
        """A column of taxels is pressed, then none, then the next one."""
        part, z = next(sent) // 10, np.zeros(MAX_TAXELS)
        z[part % COLUMNS :: COLUMNS] = 0.6 * (part % 2)
        scan = {"id": 0, "t": time.time(), "z": z.tolist()}
        sender.send_multipart([b"/skin", msgpack.packb(scan)])
        return heard.poll(50) and msgpack.unpackb(heard.recv_multipart()[1])["contacts"] > 2

    with taxeld("run", config) as daemon:
        try:
            until(has_felt)
            told = Path(f"/proc/{daemon.pid}/status").read_text(encoding="ascii")
            assert 1024 * int(re.findall(r"VmHWM:\s+(\d+) kB", told)[0]) < MOST_BYTES
        finally:
            daemon.terminate()
