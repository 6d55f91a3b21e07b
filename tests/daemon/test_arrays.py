"""`source.kind = "array"`: a daemon finds a box by arrays alone, and a recording replays."""

import json
import shutil
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zmq

from taxeld.commands.replay import Replay
from taxeld.config.file import parse
from taxeld.estimator.estimate import Status
from taxeld.skin.skin import Skin
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.sources import ReplaySource, open_source
from taxeld_protocol.array import FULL, REST, ArrayDecoder, ArrayFrame
from tests.rig.array_skin import LAYOUT, ArraySkin
from tests.rig.clocks import until
from tests.rig.configurations import configuration
from tests.rig.pressed_box import TRUTH
from tests.rig.processes import free_port, replayed, taxeld
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


@pytest.mark.parametrize(("link", "key"), [("ipc", "z"), ("udp", "counts")])
def test_the_box_is_found_by_arrays_and_again_in_the_replay(
    tmp_path: Path, link: str, key: str
) -> None:
    endpoint = f"udp://127.0.0.1:{free_port()}" if link == "udp" else f"ipc://{tmp_path}/skin"
    robot = f"tcp://127.0.0.1:{free_port()}"
    config, recorded = daemon_of(tmp_path, endpoint, robot), tmp_path / "session"
    with (
        Sockets() as sockets,
        ArraySkin(endpoint, robot, key),
        taxeld("run", "--record", recorded, config) as daemon,
    ):
        socket = sockets.subscriber(f"ipc://{tmp_path}/stream", b"/taxeld/estimate")

        def found() -> bool:
            assert daemon.poll() is None
            if not socket.poll(20):
                return False
            e = msgpack.unpackb(socket.recv_multipart()[1])
            near = abs(e["map"]["x"] - TRUTH[0]) + abs(e["map"]["y"] - TRUTH[1]) < 0.01
            return e["valid"] and near and e["status"] == Status.CONVERGED

        until(found)
        daemon.terminate()
    assert daemon.returncode == 0
    estimates = [json.loads(line) for line in replayed(recorded).splitlines()]
    assert any(e["status"] == Status.CONVERGED for e in estimates)
    assert (recorded / session.ARRAY).read_text(encoding="ascii").startswith('{"t":')
