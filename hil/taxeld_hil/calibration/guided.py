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

LOOK_S = 0.5  # between two looks at the presses
TELL_S = 10.0  # of rest, between two lines
NO_SCANS_S = 15.0  # without any scan; a hub that was just powered needs seconds
EIGHTH_DEG = 45.0  # a side of the skin


class Guided:
    """A recording that asks for presses, of a configuration with a robot."""

    def __init__(
        self,
        config: Config,
        config_path: Path,
        out: Path,
        idle_s: float,
        presses: int,
        say: Callable[[str], None],
    ) -> None:
        """`out`: file of the calibration; the session is recorded beside it.

        Raises:
            SetupError: the configuration has no robot, or something in it cannot be used.
        """
        if not config.sensor_pose.endpoint:
            raise SetupError(
                "sensor_pose.endpoint: is empty; a calibration needs the robot's poses"
            )
        config = uncalibrated(config)
        names = (".session" if k == 1 else f".session-{k}" for k in count(1))
        places = (out.with_suffix(name) for name in names)
        self.directory = next(place for place in places if not (place / session.ABOUT).exists())
        self.recording = Recording(config, config_path, self.directory)
        self._pipeline = prepared(config, time.time()).pipeline
        self._observer = Observer(self._pipeline)
        self._idle_s, self._wanted, self._say = idle_s, presses, say
        self._begun_s = self._next_look_s = time.monotonic()
        self._line = ""  # that was said last

    def run(self) -> bool:
        """Record; → whether all presses are there."""
        self._say(
            f"1. touch nothing for {self._idle_s:.0f} s; the object is held fast, the sensor away"
        )
        self._say(self.recording.run(self._on_poll))
        held = len(self._observer.presses.found()[0])
        if held >= self._wanted:
            return True
        if self.recording.failed:
            self._say("the disk took no more; make room and begin again")
            return False
        more = f"; what was recorded can be: taxeld calibrate {self.directory} --out FILE"
        self._say(
            f"ended after {held} of {self._wanted} presses: nothing is fitted"
            f"{more if held >= LEAST_PRESSES else ''}"
        )
        return False

    def _on_poll(self, scans: list[Scan], track: PoseTrack) -> None:
        now_s = time.monotonic()
        self._pipeline.stages[0].poses = track
        for outcome in self._pipeline.advance(scans, time.time()):
            self._observer.on_outcome(outcome)
        if not self.recording.scans and now_s - self._begun_s > NO_SCANS_S:
            raise SetupError(
                f"source.channel: no scan came within {NO_SCANS_S:.0f} s; check the skin "
                "(taxeld-hil accept)"
            )
        if now_s >= self._next_look_s:
            self._next_look_s, before = now_s + LOOK_S, self._line
            self._line = self._now()
            if self._line != before:
                self._say(self._line)

    def _now(self) -> str:
        """What the user has to know at this time. It is said when it changes."""
        observer, wanted, done_s = self._observer, self._wanted, self._observer.idle_s
        if done_s < self._idle_s:
            if observer.is_touched:
                raise SetupError(
                    f"calibrate: something was touched after {done_s:.0f} of {self._idle_s:.0f} s; "
                    "keep the skin clear and begin again; what was recorded can be removed"
                )
            return f"   {done_s // TELL_S * TELL_S:.0f} of {self._idle_s:.0f} s"
        if self._pipeline.poses.latest_t < 0.0:
            return "   no pose has come from the robot yet (sensor_pose.endpoint)"
        presses, unheld = observer.presses.found()
        if not presses and not unheld:
            return (
                f"2. press the object {wanted} times, 4 to 5 mm deep, each time still for a "
                "second; go round it, and turn the sensor so that another side of the skin presses"
            )
        self.recording.stopping |= len(presses) >= wanted
        felt = np.bincount(sides(observer.model, presses), minlength=8)
        least = np.where(covered(observer.model), felt, len(presses) + 1).argmin()
        also = f" ({unheld} more were not held still)" if unheld else ""
        side = f"next with the skin's side at {EIGHTH_DEG * least:.0f}°"
        return f"   {len(presses)} of {wanted}{also}; {side}"
