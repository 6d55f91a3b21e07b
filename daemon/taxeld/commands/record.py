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
from taxeld.source import modules
from taxeld.source.recorder import Recorder
from taxeld.source.sources import Source
from taxeld.stream.link import Link
from taxeld_protocol.decoder import Decoder, Scan

POLL_S = 0.002

OnPoll = Callable[[list[Scan], PoseTrack], None]


def recorder_of(config: Config, config_path: Path, directory: Path) -> Recorder:
    """The recorder for the input of this configuration.

    Raises:
        SetupError: the directory cannot be recorded into.
    """
    named = Path(config.skin.calibration) if config.skin.calibration else None
    moves, links = bool(config.sensor_pose.endpoint), len(config.names)
    return Recorder(directory, moves=moves, config=config_path, calibration=named, links=links)


class Recording:
    """A recording of a configuration's input into a directory."""

    def __init__(self, config: Config, config_path: Path, directory: Path) -> None:
        """Raises SetupError under the conditions of `recorder_of`."""
        self.config = config
        self.scans = 0
        self._directory = directory
        self._recorder = recorder_of(config, config_path, directory)

    @property
    def failed(self) -> bool:
        """Whether the disk took no more; the log has the reason."""
        return self._recorder.failed

    def run(self, ends: Callable[[], bool], on_poll: OnPoll = lambda *_: None) -> str:
        """Record until `ends`, or until the disk is full; → one line on the recording, and on the
        file that lists the modules. `on_poll` is given the scans of each poll and the sensor's
        poses.

        Raises:
            SetupError: a device or the directory cannot be used.
        """
        config, recorder = self.config, self._recorder
        tracks = [PoseTrack(on_pose) for on_pose in recorder.on_poses]
        link = Link({}, lambda *pose: tracks[pose[5]].add(*pose[:5]), {})
        skins = [layouts.load(one.skin.layout) for one in config.each]
        with recorder, closing(Inputs(config, skins, link, recorder)) as inputs:
            while not ends() and not self.failed:
                scans = inputs.poll(time.monotonic())
                self.scans += len(scans)
                on_poll([scan for scan in scans if not scan.link], tracks[0])
                time.sleep(POLL_S)
        return self._summary() + self._listed(inputs.sources[0])

    def _listed(self, source: Source) -> str:
        """Write the hubs' modules to a file for later listeners; → a line that names the file."""
        decoder, written = source.decoder, self._recorder.written
        if not isinstance(decoder, Decoder) or not (written["frames"] or written["bytes"]):
            return ""
        tables, path = modules.complete(decoder), self._directory / modules.FILE
        if not tables and decoder.refusal:
            return f"; {decoder.refusal}"
        if not tables:
            unheard = "no DECLARE and MODULE_DETAILS were heard: to replay it, list source.modules"
            return f"; {unheard}" if decoder.counters.undeclared or decoder.counters.scans else ""
        try:
            modules.write(path, tables)
        except OSError as error:
            return f"; {path} cannot be written ({error.strerror})"
        return f"; its modules are listed in {path}, for source.modules"

    def _summary(self) -> str:
        written, dropped = self._recorder.written, self._recorder.dropped
        if not (written or self.failed):
            return f"{self._directory}: nothing came, so nothing is kept"
        kind = "frames" if written["frames"] else "bytes"
        lost = f", {dropped} records dropped" if dropped else ""
        scans, poses = f"{self.scans} scans", f"{written['poses']} sensor poses"
        return f"{self._directory}: {written[kind]} {kind}, {scans}, {poses}{lost}"
