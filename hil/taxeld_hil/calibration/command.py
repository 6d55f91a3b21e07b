"""`taxeld calibrate`: entered by the `taxeld` command, which holds its options.

A skin on a robot is recorded while the user is told what to do next. A session becomes the
calibration's file, and beside it the result in words.
"""

import argparse
import signal
import time
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np

from taxeld.command_line import FAILED
from taxeld.commands.record import Recording
from taxeld.config.file import load
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.pipeline.poses import PoseTrack
from taxeld.service import calibration_file
from taxeld.service.prepare import prepared
from taxeld.source import session
from taxeld_hil import rules
from taxeld_hil.calibration.calibrate import (
    LEAST_PRESSES,
    Result,
    checked,
    covered,
    of_session,
    only_object,
    sides,
    uncalibrated,
)
from taxeld_hil.calibration.presses import Observer
from taxeld_protocol.decoder import Scan

IDLE_S, PRESSES = 60.0, 20  # seconds without touch, and presses, that are asked for
LOOK_S = 0.5  # between two looks at the presses
TELL_S = 10.0  # of rest, between two lines
NO_SCANS_S = 15.0  # without any scan; a hub that was just powered needs seconds
EIGHTH_DEG = 45.0  # a side of the skin

_say = partial(print, flush=True)


def run(args: argparse.Namespace) -> int:
    """0 fine, 1 a value is wrong, or ended before all presses were there. Raises SetupError."""
    directory, placed = args.source, None if args.object is None else np.array(args.object)
    if args.check:
        found = checked(directory, session.config_of(directory), placed)
        _say("\n".join(rules.lines(found)))
        return FAILED if rules.failed(found) else 0
    if args.out is None:
        raise SetupError("--out: is required; name the file to write, or say --check")
    if directory.is_dir():
        config = session.config_of(directory)
    else:
        config = load(args.source)
        guided = Guided(config, args.source, args.out)
        signal.signal(signal.SIGTERM, guided.stop)
        signal.signal(signal.SIGINT, guided.stop)
        if not guided.run():
            return FAILED
        signal.signal(signal.SIGINT, signal.default_int_handler)
        directory = guided.directory
    _say(_write(of_session(directory, config, placed), args.out))
    _say(f"written: {args.out}, and beside it a text")
    return 0


def _write(result: Result, out: Path) -> str:
    """Write both files; → the text. Raises SetupError where they cannot be written."""
    c, layout, _ = result
    head = f"calibration of {layout.name}, {len(layout)} taxels, on {c.object}"
    text = "\n".join([head, *rules.lines(result.rules)])
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(calibration_file.dump(c, layout), encoding="utf-8")
        out.with_suffix(".txt").write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise SetupError(
            f"--out: cannot write {error.filename or out} ({error.strerror})"
        ) from None
    return text


class Guided:
    """A recording of a skin and a robot that asks for presses, and counts them as the fit will."""

    def __init__(self, config: Config, config_path: Path, out: Path) -> None:
        """`out`: file of the calibration; the session is recorded beside it.

        Raises:
            SetupError: the configuration has no robot, or something in it cannot be used.
        """
        if not config.sensor_pose.endpoint:
            raise SetupError(
                "sensor_pose.endpoint: is empty; a calibration needs the robot's poses"
            )
        only_object(config)
        config = uncalibrated(config)
        names = (".session" if k == 1 else f".session-{k}" for k in count(1))
        places = (out.with_suffix(name) for name in names)
        self.directory = next(place for place in places if not (place / session.ARRIVALS).exists())
        self._recording = Recording(config, config_path, self.directory)
        self._observer = Observer(prepared(config, time.time()).pipeline)
        self._begun_s = self._next_look_s = time.monotonic()
        self._line = ""  # that was said last
        self._ends = False

    def stop(self, *_: object) -> None:
        """End the recording; takes a signal's arguments."""
        self._ends = True

    def run(self) -> bool:
        """Record; → whether all presses are there."""
        _say(f"1. touch nothing for {IDLE_S:.0f} s; the object is held fast, the sensor away")
        _say(self._recording.run(lambda: self._ends, self._on_poll))
        held = len(self._observer.found()[0])
        if held >= PRESSES:
            return True
        if self._recording.failed:
            _say("the disk took no more; make room and begin again")
            return False
        more = f"; what was recorded can be: taxeld calibrate {self.directory} --out FILE"
        _say(
            f"ended after {held} of {PRESSES} presses: nothing is fitted"
            f"{more if held >= LEAST_PRESSES else ''}"
        )
        return False

    def _on_poll(self, scans: list[Scan], track: PoseTrack) -> None:
        now_s, pipeline = time.monotonic(), self._observer.pipeline
        pipeline.stages[0].poses = track
        for outcome in pipeline.advance(scans, time.time()):
            self._observer.on_outcome(outcome)
        if not self._recording.scans and now_s - self._begun_s > NO_SCANS_S:
            raise SetupError(
                f"source.channel: no scan came within {NO_SCANS_S:.0f} s; check the hub's power, "
                "and what is logged above"
            )
        if now_s >= self._next_look_s:
            self._next_look_s, before = now_s + LOOK_S, self._line
            self._line = self._now()
            if self._line != before:
                _say(self._line)

    def _now(self) -> str:
        """What the user has to know at this time. It is said when it changes."""
        observer, done_s = self._observer, self._observer.idle_s
        if done_s < IDLE_S:
            if observer.is_touched:
                raise SetupError(
                    f"calibrate: something was touched after {done_s:.0f} of {IDLE_S:.0f} s; "
                    "keep the skin clear and begin again; what was recorded can be removed"
                )
            return f"   {done_s // TELL_S * TELL_S:.0f} of {IDLE_S:.0f} s"
        if observer.pipeline.poses.latest_t < 0.0:
            return "   no pose has come from the robot yet (sensor_pose.endpoint)"
        presses, unheld = observer.found()
        if not presses and not unheld:
            return (
                f"2. press the object {PRESSES} times, 4 to 5 mm deep, each time still for a "
                "second; go round it, and turn the sensor so that another side of the skin presses"
            )
        self._ends |= len(presses) >= PRESSES
        model = observer.pipeline.estimator.model
        felt = np.bincount(sides(model, presses), minlength=8)
        least = np.where(covered(model), felt, len(presses) + 1).argmin()
        also = f" ({unheld} more were not held still)" if unheld else ""
        side = f"next with the skin's side at {EIGHTH_DEG * least:.0f}°"
        return f"   {len(presses)} of {PRESSES}{also}; {side}"
