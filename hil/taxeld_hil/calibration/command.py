"""`taxeld calibrate`: entered by the `taxeld` command, which holds its options.

It writes the calibration's file, and beside it the result in words and as a picture.
"""

import argparse
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from taxeld.command_line import FAILED
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.service import calibration_file
from taxeld.source import session
from taxeld_hil.calibration import check
from taxeld_hil.calibration.calibrate import MOST_LEFT, Result, of_session
from taxeld_hil.calibration.guided import Guided
from taxeld_hil.calibration.picture import draw

IDLE_S, PRESSES = 60.0, 20  # seconds without touch, and presses, that are asked for

_say = partial(print, flush=True)


def run(args: argparse.Namespace) -> int:
    """0 fine, 1 a value is wrong, or ended before all presses were there. Raises SetupError."""
    placed = None if args.object is None else np.array(args.object)
    directory = args.source
    if args.check:
        found = check.of_session(directory, session.config_of(directory))
        _say("\n".join(found.lines()))
        return FAILED if found.is_wrong else 0
    if args.out is None:
        raise SetupError("--out: is required; name the file to write, or say --check")
    if directory.is_dir():
        config = session.config_of(directory)
    else:
        config = load(args.source)
        directory = Guided.place(args.out)
        guided = Guided(config, args.source, directory, IDLE_S, PRESSES, _say)
        signal.signal(signal.SIGTERM, lambda *_: guided.stop())
        signal.signal(signal.SIGINT, lambda *_: guided.stop())
        if not guided.run():
            return FAILED
        signal.signal(signal.SIGINT, signal.default_int_handler)
    result = of_session(directory, config, placed)
    write(result, args.out)
    _say("\n".join(lines(result)))
    _say(f"written: {args.out}, and beside it a text and a picture")
    return 0


def write(result: Result, out: Path) -> None:
    """Write the three files. Raises SetupError where they cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        text = calibration_file.dump(result.calibration, result.observed.model.layout)
        out.write_text(text, encoding="utf-8")
        out.with_suffix(".txt").write_text("\n".join([*lines(result), ""]), encoding="utf-8")
        draw(result, out.with_suffix(".png"))
    except OSError as error:
        raise SetupError(
            f"--out: cannot write {error.filename or out} ({error.strerror})"
        ) from None


def lines(result: Result) -> Iterator[str]:
    """Measured values, their uncertainty, and taxels that could not be measured."""
    c, fit, observed, known = result.calibration, result.fit, result.observed, result.known
    layout, idle = observed.model.layout, observed.idle
    yield f"calibration of {layout.name}, {len(layout)} taxels, on {c.object}"
    yield (
        f"idle       {idle.seconds:.0f} s: noise {np.median(c.noise_counts):.1f} counts (median), "
        f"{c.noise_counts.max():.1f} at most; drift {np.abs(idle.drift).max():.1f} counts/min at "
        "most"
    )
    unheld = f", {observed.unheld} more were not held still" if observed.unheld else ""
    yield f"presses    {c.presses}{unheld}; {np.count_nonzero(fit.weight)} readings are used"
    where = "given" if result.given else "found by touch"
    x, y, yaw = fit.value.object
    yield f"object     x {x:.4f} m, y {y:.4f} m, yaw {yaw:.4f} rad, {where}"
    x, y, yaw = c.mount
    x_sd, y_sd, yaw_sd = c.mount_sd
    yield (
        f"mount      x {1e3 * x:+.2f} ± {1e3 * x_sd:.2f} mm, "
        f"y {1e3 * y:+.2f} ± {1e3 * y_sd:.2f} mm, "
        f"yaw {np.degrees(yaw):+.2f} ± {np.degrees(yaw_sd):.2f}°"
    )
    yield (
        f"full scale {c.full_scale_counts:.0f} counts ± {100 * c.full_scale_sd:.1f} % at "
        f"{1e3 * c.full_scale_depth_m:g} mm"
    )
    spread = np.std(np.log(c.gain[known])) if known.sum() > 2 else float("nan")
    yield (
        f"gains      {int(known.sum())} of {len(layout)} taxels measured to "
        f"{100 * np.median(c.gain_sd[known]) if known.any() else 0:.1f} % (median), "
        f"spread {100 * spread:.0f} %; the others keep the spread of the skin"
    )
    onset = np.median(c.onset)
    yield f"response   bend {c.bend:+.3f} ± {c.bend_sd:.3f}; onsets {onset:+.2f} (median)"
    share = 100 * c.gain_cv
    yield f"activation noise {c.noise_sigma:.3f} of full scale, and {share:.0f} % of a reading"
    yield f"left over  {fit.left / MOST_LEFT:.2f} of what may be"
    yield f"frozen     {', '.join(map(str, np.flatnonzero(c.frozen))) or 'none'}"
