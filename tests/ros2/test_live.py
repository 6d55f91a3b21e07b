"""The bridge beside a running daemon, which replays four contacts of a mug."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgpack
import pytest
import zmq

from taxeld.stream import messages

pytest.importorskip("cyclonedds")

from taxeld_ros2.convert import SILENT, time_of

from ..system.test_clients import configured
from .loopback import Lines, bridge, until
from .test_bridge import HEAR, TOPICS, Heard

ENOUGH = 20  # poses


def test_what_a_running_daemon_estimates_is_heard_as_ros_messages(tmp_path: Path) -> None:
    config = configured(tmp_path)
    reader = Lines([sys.executable, str(HEAR), *TOPICS])
    heard = Heard(reader.lines)
    said: dict[bytes, list[dict[str, Any]]] = {}
    with (
        bridge(str(config)),
        zmq.Context() as context,
        context.socket(zmq.SUB) as stream,
    ):
        stream.setsockopt(zmq.LINGER, 0)
        stream.setsockopt(zmq.RCVHWM, 0)
        stream.setsockopt(zmq.SUBSCRIBE, b"/taxeld/")
        stream.connect(f"ipc://{tmp_path}/stream")
        until(lambda: heard.of("diagnostics"))  # that there is no daemon yet
        with subprocess.Popen([sys.executable, "-m", "taxeld.cli", "run", config]) as daemon:
            try:
                until(lambda: len(heard.of("taxeld/pose")) >= ENOUGH)
                until(lambda: any(m["markers"][5]["points"] for m in heard.of("taxeld/markers")))
            finally:
                daemon.terminate()
        while stream.poll(200):
            topic, body, _ = stream.recv_multipart()
            said.setdefault(topic, []).append(msgpack.unpackb(body))
    reader.close()
    stamps = [(time_of(e["t"]), e["mean"]) for e in said[messages.ESTIMATE]]
    means = {(stamp.sec, stamp.nanosec): mean for stamp, mean in stamps}
    for pose in heard.of("taxeld/pose"):
        stamp, at = pose["header"]["stamp"], pose["pose"]["pose"]["position"]
        mean = means[stamp["sec"], stamp["nanosec"]]
        assert (at["x"], at["y"]) == (mean["x"], mean["y"])
        assert pose["header"]["frame_id"] == "world", "the session has a robot"
    outline = said[messages.INFO][0]["outline"]
    assert any(
        len(m["markers"][0]["points"]) == len(outline) + 1 for m in heard.of("taxeld/markers")
    )
    named = {d["status"][0]["message"] for d in heard.of("diagnostics")}
    assert {SILENT, "starting", "searching"} <= named
