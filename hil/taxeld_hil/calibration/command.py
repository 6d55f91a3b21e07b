"""`taxeld calibrate`: entered by the `taxeld` command, which holds its options.

It writes the calibration's file, and beside it the result in words and as a picture.
"""

import argparse
import signal
from functools import partial
from pathlib import Path

import numpy as np

from taxeld.command_line import FAILED
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.service import calibration_file
from taxeld.source import session
from taxeld_hil import rules
from taxeld_hil.calibration import check
from taxeld_hil.calibration.calibrate import Result, of_session
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
        _say("\n".join(rules.lines(found)))
        return FAILED if rules.failed(found) else 0
    if args.out is None:
        raise SetupError("--out: is required; name the file to write, or say --check")
    if directory.is_dir():
        config = session.config_of(directory)
    else:
        config = load(args.source)
        guided = Guided(config, args.source, args.out, IDLE_S, PRESSES, _say)

        def stop(*_: object) -> None:
            guided.recording.stopping = True

        signal.signal(signal.SIGTERM, stop)
        signal.signal(signal.SIGINT, stop)
        if not guided.run():
            return FAILED
        signal.signal(signal.SIGINT, signal.default_int_handler)
        directory = guided.directory
    result = of_session(directory, config, placed)
    _say(_write(result, args.out))
    _say(f"written: {args.out}, and beside it a text and a picture")
    return 0


def _write(result: Result, out: Path) -> str:
    """Write the three files; → the text. Raises SetupError where they cannot be written."""
    c, layout = result.calibration, result.model.layout
    head = f"calibration of {layout.name}, {len(layout)} taxels, on {c.object}"
    text = "\n".join([head, *rules.lines(result.rules)])
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(calibration_file.dump(c, layout), encoding="utf-8")
        out.with_suffix(".txt").write_text(text + "\n", encoding="utf-8")
        draw(result, out.with_suffix(".png"))
    except OSError as error:
        raise SetupError(
            f"--out: cannot write {error.filename or out} ({error.strerror})"
        ) from None
    return text
