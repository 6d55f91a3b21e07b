"""`taxeld calibrate`: entered by the `taxeld` command, which holds its options."""

import argparse
import signal
from functools import partial

import numpy as np

from taxeld.command_line import FAILED
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld_hil.calibration import report
from taxeld_hil.calibration.calibrate import of_session
from taxeld_hil.calibration.guided import Guided

_say = partial(print, flush=True)


def run(args: argparse.Namespace) -> int:
    """0 fine, 1 ended before all presses were there. Raises SetupError."""
    placed = None if args.object is None else np.array(args.object)
    directory = args.source
    if directory.is_dir():
        config = load(args.config or directory / session.CONFIG)
    else:
        if args.config:
            raise SetupError(
                "--config: is only for a session; a running skin has its own configuration"
            )
        config = load(args.source)
        directory = Guided.place(args.out)
        guided = Guided(config, args.source, directory, args.idle_s, args.presses, _say)
        signal.signal(signal.SIGTERM, lambda *_: guided.stop())
        signal.signal(signal.SIGINT, lambda *_: guided.stop())
        if not guided.run():
            return FAILED
        signal.signal(signal.SIGINT, signal.default_int_handler)
    result = of_session(directory, config, placed)
    report.write(result, args.out)
    _say("\n".join(report.lines(result)))
    _say(f"written: {args.out}, and beside it a text and a picture")
    return 0
