"""`taxeld record`: the data of a skin and a robot, as a session, without estimates.

It is a process of its own that brings the skin up; `taxeld run --record` records beside estimates.
"""

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from taxeld.config.tables import Config
from taxeld.layout import read as layouts
from taxeld.pipeline.poses import PoseTrack
from taxeld.service.inputs import Inputs
from taxeld.source.recorder import Recorder
from taxeld.source.session import Pass, SensorPose
from taxeld.stream.link import Link
from taxeld_protocol.decoder import Scan

POLL_S = 0.002

OnPoll = Callable[[list[Scan], PoseTrack], None]


def recorder_of(config: Config, config_path: Path, directory: Path) -> Recorder:
    """The recorder for the input of this configuration.

    Raises:
        SetupError: the directory cannot be recorded into.
    """
    named = Path(config.skin.calibration) if config.skin.calibration else None
    modules = {numbers[0]: source.modules for source, numbers in config.buses}
    moves = bool(config.sensor_pose.endpoint)
    return Recorder(directory, moves=moves, modules=modules, config=config_path, calibration=named)


class Recording:
    """A recording of a configuration's input into a directory."""

    def __init__(self, config: Config, config_path: Path, directory: Path) -> None:
        """Raises SetupError under the conditions of `recorder_of`."""
        self.config = config
        self.scans = 0
        self._directory = directory
        self._recorder = recorder_of(config, config_path, directory)
        self._tracks = [PoseTrack() for _ in config.each]

    @property
    def failed(self) -> bool:
        """Whether the disk took no more; the log has the reason."""
        return self._recorder.failed

    def run(self, ends: Callable[[], bool], on_poll: OnPoll = lambda *_: None) -> str:
        """Record until `ends`, or until the disk is full; → one line on the recording. `on_poll` is
        given the scans of each poll and the first link's poses.

        Raises:
            SetupError: a device or the directory cannot be used.
        """
        config, recorder = self.config, self._recorder
        link = Link({}, self._on_pose, {})
        skins, passes_s = [layouts.load(one.skin.layout) for one in config.each], 0.0
        with recorder, closing(Inputs(config, skins, link, recorder)) as inputs:
            while not ends() and not self.failed:
                now_s = time.monotonic()
                scans = inputs.poll(now_s)
                if scans:
                    link.ask_poses(also_next=True)
                    passes_s = now_s + config.sensor_pose.wait_s + POLL_S
                if now_s < passes_s:  # scans may wait for poses, as in a daemon
                    recorder.take(Pass(time.time()))
                self.scans += len(scans)
                on_poll([scan for scan in scans if not scan.link], self._tracks[0])
                time.sleep(POLL_S)
        return self._summary()

    def _on_pose(self, t: float, x: float, y: float, theta: float, came: float, link: int) -> None:
        self._recorder.take(SensorPose(t, x, y, theta), link, came)
        self._tracks[link].add(t, x, y, theta, came)

    def _summary(self) -> str:
        written, dropped = self._recorder.written, self._recorder.dropped
        if not (written or self.failed):
            return f"{self._directory}: nothing came, so nothing is kept"
        lost = f", {dropped} of {written + dropped} records dropped" if dropped else ""
        poses = sum(track.taken for track in self._tracks)
        return f"{self._directory}: {self.scans} scans, {poses} sensor poses{lost}"
