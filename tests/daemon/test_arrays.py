"""`source.kind = "array"`: a daemon finds a box by arrays alone, and a recording replays."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest

from taxeld.config.tables import SkinConfig, SourceConfig
from taxeld.estimator.estimate import Status
from taxeld.skin.skin import Skin
from taxeld.source.sources import ArraySource
from taxeld_protocol.array import FULL, REST, ArrayDecoder, ArrayFrame
from taxeld_protocol.decoder import Scan
from tests.rig.array_skin import LAYOUT, ArraySkin
from tests.rig.clocks import until
from tests.rig.configurations import configuration
from tests.rig.pressed_box import TRUTH
from tests.rig.processes import free_port, replayed, taxeld
from tests.rig.sessions import items_of
from tests.rig.skins import SKIN
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


def test_activations_are_the_senders_from_the_first_scan_on() -> None:
    z = np.linspace(0.1, 1.0, len(SKIN))
    counts = tuple(REST + round(v * FULL) for v in z)
    skin = Skin(SKIN, SkinConfig())
    for scan in scans([ArrayFrame(1e9 + i, "", REST, counts) for i in range(300)]):
        activation = skin.on_scan(scan)
        assert activation is not None
        np.testing.assert_allclose(activation.z, z, atol=1e-4)  # no drift takes a long press away
        assert activation.live.all()
    skin.tare()
    activation = skin.on_scan(scan)
    assert activation is not None
    np.testing.assert_allclose(activation.z, z, atol=1e-4)


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
    assert found[-1] is not None
    assert found[-1].z.argmax() == 3
    assert found[-1].z[3] == pytest.approx(0.5, abs=0.01)


def test_values_stand_in_the_layouts_order_whatever_its_uids() -> None:
    order = np.random.default_rng(2).permutation(len(SKIN))
    skin = Skin(replace(SKIN, uid=order.astype(np.int64)), SkinConfig())  # 0, 12, 15 …
    z = np.linspace(0.1, 1.0, len(SKIN))
    counts = tuple(REST + round(v * FULL) for v in z)
    (scan,) = scans([ArrayFrame(1.0, "", REST, counts)], order.tolist())
    activation = skin.on_scan(scan)
    assert activation is not None
    np.testing.assert_allclose(activation.z, z, atol=1e-4)
    assert not skin.wiring.lacking


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
