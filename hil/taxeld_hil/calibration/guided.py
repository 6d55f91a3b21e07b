"""A skin on a robot is recorded while the user is told what to do next.

Presses are counted as the fit will count them.
"""

import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import numpy as np

from taxeld.commands.record import Recording
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.pipeline.poses import PoseTrack
from taxeld.service.prepare import prepared
from taxeld.source import session
from taxeld_hil.calibration.calibrate import LEAST_PRESSES, covered, sides
from taxeld_hil.calibration.observer import Observer, uncalibrated
from taxeld_protocol.decoder import Scan

LOOK_S = 0.5  # between two looks for presses that have ended
TELL_S = 10.0  # between two equal lines
NO_SCANS_S = 15.0  # without any scan; a hub that was just powered needs seconds
EIGHTH_DEG = 45.0  # a side of the skin


class Guided:
    """A recording that asks for presses, of a configuration with a robot."""

    def __init__(
        self,
        config: Config,
        config_path: Path,
        directory: Path,
        idle_s: float,
        presses: int,
        say: Callable[[str], None],
    ) -> None:
        """`directory`: of the session that is recorded.

        Raises:
            SetupError: the configuration has no robot, or something in it cannot be used.
        """
        if not config.sensor_pose.endpoint:
            raise SetupError(
                "sensor_pose.endpoint: is empty; a calibration needs the robot's poses"
            )
        config = uncalibrated(config)
        self._pipeline = prepared(config, time.time()).pipeline
        self._observer = Observer(self._pipeline)
        self._recording = Recording(config, config_path, directory)
        self._directory = directory
        self._idle_s, self._wanted, self._say = idle_s, presses, say
        self._begun_s = time.monotonic()
        self._next_look_s = self._next_line_s = self._begun_s
        self._came = self._asked = False
        self._held = self._unheld = 0  # presses so far

    @staticmethod
    def place(out: Path) -> Path:
        """Directory for the session of a calibration that is written to `out`: beside it, and
        without a session yet."""
        names = (".session" if k == 1 else f".session-{k}" for k in count(1))
        places = (out.with_suffix(name) for name in names)
        return next(place for place in places if not (place / session.ABOUT).exists())

    def stop(self) -> None:
        """End before all presses are there."""
        self._recording.stopping = True

    def run(self) -> bool:
        """Record; → whether all presses are there."""
        self._say(
            f"1. touch nothing for {self._idle_s:.0f} s; the object is held fast, the sensor away"
        )
        self._say(self._recording.run(self._on_poll))
        if self._held >= self._wanted:
            return True
        if self._recording.failed:
            self._say("the disk took no more; make room and begin again")
        else:
            more = f"; what was recorded can be: taxeld calibrate {self._directory} --out FILE"
            self._say(
                f"ended after {self._held} of {self._wanted} presses: nothing is fitted"
                f"{more if self._held >= LEAST_PRESSES else ''}"
            )
        return False

    def _on_poll(self, scans: list[Scan], track: PoseTrack) -> None:
        now_s = time.monotonic()
        self._pipeline.stages[0].poses = track
        self._came |= bool(scans)
        for outcome in self._pipeline.advance(scans, time.time()):
            self._observer.on_outcome(outcome)
        if not self._came and now_s - self._begun_s > NO_SCANS_S:
            raise SetupError(
                f"source.channel: no scan came within {NO_SCANS_S:.0f} s; check the skin "
                "(taxeld-hil accept)"
            )
        if now_s >= self._next_look_s:
            self._next_look_s = now_s + LOOK_S
            said = self._press(now_s) if self._asked else self._rest(now_s)
            if said:
                self._say(said)
                self._next_line_s = now_s + TELL_S

    def _rest(self, now_s: float) -> str:
        """A line to say while the skin must be left alone, or nothing."""
        done_s = self._observer.idle_s
        if done_s >= self._idle_s:
            self._asked = True
            return (
                f"2. press the object {self._wanted} times, 4 to 5 mm deep, each time still for a "
                "second; go round it, and turn the sensor so that another side of the skin presses"
            )
        if self._observer.is_touched:
            raise SetupError(
                f"calibrate: something was touched after {done_s:.0f} of {self._idle_s:.0f} s; "
                "keep the skin clear and begin again; what was recorded can be removed"
            )
        if now_s < self._next_line_s:
            return ""
        return f"   {done_s:.0f} of {self._idle_s:.0f} s" if done_s else "   waiting for scans"

    def _press(self, now_s: float) -> str:
        """A line to say of the presses so far, or nothing."""
        presses, unheld = self._observer.presses()
        held, self._held = self._held, len(presses)
        if unheld > self._unheld and held == self._held:
            self._unheld = unheld
            return "   that one was not held still; it does not count"
        so_far = f"   {self._held} of {self._wanted}"
        if self._held >= self._wanted:
            self._recording.stopping = True
            return so_far
        if self._held > held:
            model = self._pipeline.estimator.model
            felt = np.bincount(sides(model, presses), minlength=8)
            least = np.where(covered(model), felt, len(presses) + 1).argmin()
            return f"{so_far}; next with the skin's side at {EIGHTH_DEG * least:.0f}°"
        if now_s < self._next_line_s:
            return ""
        if self._pipeline.poses.latest_t < 0.0:
            return f"{so_far}; no pose has come from the robot yet (sensor_pose.endpoint)"
        return f"{so_far}; waiting for a press"
