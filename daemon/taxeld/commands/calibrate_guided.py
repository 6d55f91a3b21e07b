"""The guided form of `taxeld calibrate`: a session is recorded while it is said what to do next.

What it says comes from the same reading of presses that the fit will do, so a press that is counted
here is one that counts.
"""

import time
from itertools import count
from pathlib import Path

import numpy as np

from taxeld.commands.calibrate import LEAST_IDLE_S
from taxeld.commands.hearing import Hearing, Say, uncalibrated
from taxeld.commands.record import Recording
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.pipeline.pipeline import Pipeline
from taxeld.pipeline.poses import PoseTrack
from taxeld.proposals import bundle
from taxeld.skin import calibration_search
from taxeld.source import session
from taxeld_protocol.decoder import Scan

TELL_S = 10.0  # between two lines of the same
NO_SCANS_S = 15.0  # without a single one: a hub that was just powered needs seconds
EIGHTH_DEG = 45.0


class Guided:
    """A skin on a robot, being pressed."""

    def __init__(
        self,
        config: Config,
        config_path: Path,
        directory: Path,
        idle_s: float,
        presses: int,
        say: Say,
    ) -> None:
        """`directory`: of the session that is recorded.

        Raises:
            SetupError: the configuration has no robot, or something of it cannot be used.
        """
        if idle_s < LEAST_IDLE_S:
            raise SetupError(f"--idle-s: must be {LEAST_IDLE_S:g} or more, not {idle_s:g}")
        if presses < calibration_search.LEAST_PRESSES:
            least = calibration_search.LEAST_PRESSES
            raise SetupError(f"--presses: must be {least} or more, not {presses}")
        if not config.sensor_pose.endpoint:
            raise SetupError(
                "sensor_pose.endpoint: is empty; a calibration needs the robot's poses"
            )
        config = uncalibrated(config)
        layout = layouts.load(config.skin.layout)
        scene = bundle.load(config.scene.bundle, layout, config.skin.full_scale_depth_m)
        self._pipeline = Pipeline(config, scene.model, scene.untimed(config.filter))
        self._hearing = Hearing(self._pipeline)
        self._recording = Recording(config, config_path, directory)
        self._directory = directory
        self._idle_s, self._presses, self._say = idle_s, presses, say
        self._next_line_s = self._begun_s = time.monotonic()
        self._scans = self._moving = 0
        self._asked = False

    @staticmethod
    def place(out: Path) -> Path:
        """Where the session of a calibration that is written to `out` is kept: beside it, in a
        directory that holds none yet."""
        for number in count(1):
            place = out.with_suffix(".session" if number == 1 else f".session-{number}")
            if not (place / session.ABOUT).exists():
                return place
        raise AssertionError

    def stop(self) -> None:
        """End before all presses are there."""
        self._recording.stopping = True

    def run(self) -> bool:
        """Record; → whether all presses are there."""
        self._say(
            f"1. touch nothing for {self._idle_s:.0f} s; the object is held fast, the sensor away"
        )
        self._say(self._recording.run(self._on_poll))
        if len(self._hearing) >= self._presses:
            return True
        if self._recording.failed:
            self._say("the disk took no more; make room and begin again")
        else:
            done = f"{len(self._hearing)} of {self._presses} presses"
            least = calibration_search.LEAST_PRESSES
            more = f"; what was recorded can be: taxeld calibrate {self._directory} --out FILE"
            enough = more if len(self._hearing) >= least else ""
            self._say(f"ended after {done}: nothing is fitted{enough}")
        return False

    def _on_poll(self, scans: list[Scan], track: PoseTrack) -> None:
        """What has come since the last call."""
        pipeline, now_s = self._pipeline, time.monotonic()
        pipeline.poses = track
        self._scans += len(scans)
        ended = False
        for outcome in pipeline.advance(scans, time.time()):
            ended |= self._hearing.on_outcome(outcome)
        if not self._scans and now_s - self._begun_s > NO_SCANS_S:
            raise SetupError(
                f"source.channel: no scan came within {NO_SCANS_S:.0f} s; check the skin "
                "(taxeld-hil accept)"
            )
        if not self._asked:
            self._rest(now_s)
        elif ended or self._hearing.moving > self._moving or now_s >= self._next_line_s:
            self._press(now_s, ended=ended)

    def _rest(self, now_s: float) -> None:
        hearing, done_s = self._hearing, self._hearing.idle.seconds
        if hearing.is_touched and done_s < self._idle_s:
            raise SetupError(
                f"calibrate: something was touched after {done_s:.0f} of {self._idle_s:.0f} s; "
                "keep the skin clear and begin again; what was recorded can be removed"
            )
        if done_s >= self._idle_s:
            self._asked = True
            self._say(
                f"2. press the object {self._presses} times, 4 to 5 mm deep, each time still for a "
                "second; go round it, and turn the sensor so that another side of the skin presses"
            )
            self._next_line_s = now_s + TELL_S
        elif now_s >= self._next_line_s:
            self._next_line_s = now_s + TELL_S
            self._say(
                f"   {done_s:.0f} of {self._idle_s:.0f} s" if done_s else "   waiting for scans"
            )

    def _press(self, now_s: float, *, ended: bool) -> None:
        hearing = self._hearing
        self._next_line_s = now_s + TELL_S
        if not ended and hearing.moving > self._moving:
            self._moving = hearing.moving
            self._say("   that one was not held still; it does not count")
            return
        so_far = f"   {len(hearing)} of {self._presses}"
        if len(hearing) >= self._presses:
            self._say(so_far)
            self._recording.stopping = True
        elif ended:
            self._say(f"{so_far}; next with the skin's side at {self._wanted():.0f}°")
        elif self._pipeline.poses.latest_t < 0.0:
            self._say(f"{so_far}; no pose has come from the robot yet (sensor_pose.endpoint)")
        else:
            self._say(f"{so_far}; waiting for a press")

    def _wanted(self) -> float:
        """The angle about the sensor's axis [°] of the side that was pressed least."""
        model = self._pipeline.estimator.model
        felt = np.bincount(calibration_search.sides(model, self._hearing.presses), minlength=8)
        has = calibration_search.covered(model)
        return float(EIGHTH_DEG * np.where(has, felt, 1_000_000).argmin())
