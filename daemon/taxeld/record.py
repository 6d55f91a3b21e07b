"""`taxeld record`: what a skin and a robot send, as a session, and nothing estimated.

A process of its own, so that writing never delays a daemon's loop; it brings the skin up itself.
"""

import shutil
import time
from pathlib import Path

import zmq

from taxeld import curve, layout, session
from taxeld.config import Config
from taxeld.curve import Guard
from taxeld.errors import SetupError
from taxeld.poses import PoseTrack
from taxeld.session import Recorder
from taxeld.sources import open_source
from taxeld.streams import PoseInput

POLL_S = 0.002


class Recording:
    """A configuration, being recorded into a directory."""

    def __init__(self, config: Config, config_path: Path, directory: Path) -> None:
        self.config = config
        self.stopping = False
        self.scans = 0
        self._config_path = config_path
        self._directory = directory

    def run(self) -> str:
        """Record until `stopping`; → one line on what was recorded.

        Raises:
            SetupError: a device or the directory cannot be used.
        """
        config = self.config
        if config.source.kind == "replay":
            raise SetupError("source.kind: 'replay' is a recording already; use can or serial")
        endpoint, keys = config.sensor_pose.endpoint, curve.load(config)
        with Recorder(self._directory, moves=bool(endpoint)) as recorder, zmq.Context() as context:
            source = open_source(config.source, layout.load(config.skin.layout), recorder)
            shutil.copyfile(self._config_path, self._directory / session.CONFIG)
            track = PoseTrack(config.sensor_pose.max_age_s, on_pose=recorder.pose)
            robot = PoseInput(context, track, Guard(context, keys, config.curve))
            try:
                if endpoint:
                    robot.connect(endpoint)
                while not self.stopping:
                    robot.poll()
                    self.scans += len(source.poll(time.monotonic()))
                    time.sleep(POLL_S)
            finally:
                robot.close()
                source.close()
            sent = f"{recorder.frames} frames" if recorder.frames else f"{recorder.bytes} bytes"
            return f"{self._directory}: {sent}, {self.scans} scans, {recorder.poses} sensor poses"
