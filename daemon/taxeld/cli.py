"""`taxeld`: the daemon and the commands beside it."""

import argparse
import json
import math
import sys
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from taxeld import command_line
from taxeld.command_line import FAILED, Arguments, Run, flag, given, natural
from taxeld.config.file import load
from taxeld.config.gate import ConfigError
from taxeld.errors import SetupError


def main(argv: list[str] | None = None) -> int:
    """Run the command line; → 0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    """Run the daemon until it is stopped.

    taxeld run can0.toml
    taxeld run --record session can0.toml
    """
    # the other commands need neither zmq nor a device
    from taxeld.commands.record import recorder_of
    from taxeld.service import log
    from taxeld.service.loop import Daemon

    with log.written():
        config = load(args.config)
        log.set_level(config.log.level)
        out = args.record
        with recorder_of(config, args.config, out) if out else nullcontext() as recorder:
            Daemon(config, recorder).run(command_line.stopping())
    return 0


def _record(args: argparse.Namespace) -> int:
    """Record what skin and robot send; nothing is estimated.

    taxeld record --out session can0.toml
    """
    from taxeld.commands.record import Recording

    recording = Recording(load(args.config), args.config, args.out)
    print(recording.run(command_line.stopping()))
    return FAILED if recording.failed else 0


def _init(args: argparse.Namespace) -> int:
    """Write a configuration with a comment on each key.

    taxeld init can0.toml --source can:can0 --bundle box --poses tcp://127.0.0.1:9874
    """
    from taxeld.commands import init

    config = init.write(args.config, vars(args))
    source = f"{config.source.kind} {config.source.where}"
    source += f", object {config.scene.bundle}" if config.scene.bundle else ", no object"
    print(f"written: {args.config} ({source}); next: taxeld check {args.config}")
    return 0


def _check(args: argparse.Namespace) -> int:
    """Check everything that a run needs; one line for each fault.

    taxeld check can0.toml
    """
    from taxeld.commands import check

    config = load(args.config)
    if faults := check.faults(config):
        raise ConfigError(faults)
    print("\n".join([f"{args.config}: fine", *(f"note: {line}" for line in check.notes(config))]))
    return 0


def _export(args: argparse.Namespace) -> int:
    """Write a session as files for other tools: candump's log, tables of scans and poses.

    taxeld export session --out exported
    """
    from taxeld.commands.export import export

    print("\n".join(f"written: {path}" for path in export(args.session, args.out)))
    return 0


def _replay(args: argparse.Namespace) -> int:
    """Estimate from a recorded session; one JSON line for each estimate.

    taxeld replay session > estimates.jsonl
    """
    from taxeld.commands.replay import replay
    from taxeld.source import session

    config = session.config_of(args.directory, args.config)
    for line in replay(args.directory, config, args.seed):
        print(line)
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    """Measure full scale, gains, noise and mount of a skin from presses on a fixed object.

    taxeld calibrate can0.toml --out skin.toml
    taxeld calibrate session --out skin.toml --object 0.40 0.10 1.57
    taxeld calibrate session --check
    """
    from importlib.metadata import entry_points

    for entry in entry_points(group="taxeld.commands", name="calibrate"):  # the harness has it
        return int(entry.load()(args))
    raise SetupError("calibrate: taxeld is not installed here; pip install -e . in its clone")


def _layout(args: argparse.Namespace) -> int:
    """Describe the layout of a skin.

    taxeld layout cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015
    taxeld layout skin.json
    """
    from taxeld.commands.layout import next_command, summary
    from taxeld.layout import read as layouts

    skin = layouts.read(args.layout)
    print("\n".join([*summary(skin), *next_command(args.layout, skin)]))
    return 0


def _status(args: argparse.Namespace) -> int:
    """Show what a running daemon believes and counts.

    taxeld status
    taxeld status can0.toml --json
    """
    from taxeld.commands.status import lines

    answer = _answer(args, "status")
    print(json.dumps(answer, indent=1) if args.json else "\n".join(lines(answer)))
    return 0


def _tare(args: argparse.Namespace) -> int:
    """Have a running daemon learn the idle baseline again; do not touch the skin.

    taxeld tare can0.toml
    """
    _answer(args, "tare")
    print("the idle baseline is being learned again; leave the skin untouched until it is")
    return 0


def _reset(args: argparse.Namespace) -> int:
    """Have a running daemon forget all touches.

    taxeld reset can0.toml
    """
    _answer(args, "reset")
    print("all touches are forgotten")
    return 0


def _prior(args: argparse.Namespace) -> int:
    """Tell a running daemon where the object may be.

    taxeld prior can0.toml --at 0.4 0.1 nan
    taxeld prior ipc:///run/taxeld/control --at 0.4 0.1 1.57 --sd 0.01 0.01 0.1
    """
    x, y, yaw = args.at
    theta = None if math.isnan(yaw) else yaw
    _answer(args, "prior", x=x, y=y, theta=theta, cov=args.sd)
    print("the prior is taken; touches may refute it")
    return 0


def _answer(args: argparse.Namespace, command: str, **what: object) -> dict[str, Any]:
    from taxeld.commands import running

    return running.answer(running.endpoint_of(args.daemon, running.CONTROL), command, **what)


def _advise(args: argparse.Namespace) -> int:
    """Rank approaches that the robot can make by what a touch there would tell.

    taxeld advise can0.toml --candidates ring.csv
    taxeld advise can0.toml --candidates ring.csv --json
    """
    from taxeld.advice.advice import advise
    from taxeld.commands.advise import lines, read, remembered

    config = load(args.config)
    candidates = read(args.candidates, config.names)
    found = advise(remembered(config), candidates)
    told = [json.dumps(asdict(each)) for each in found] if args.json else lines(found, config.names)
    print("\n".join(told))
    return 0


def _view(args: argparse.Namespace) -> int:
    """Show a running daemon or a session in three dimensions, with plots.

    taxeld view
    taxeld view can0.toml --save live.rrd
    taxeld view session
    """
    from taxeld.view import view

    print(view.run(args.source, args.save, args.seconds, command_line.stopping()))
    return 0


CONFIG = given("config", "CONFIG", "a configuration", Path)
DAEMON_ABOUT = "of a daemon (default: of the service, or of this user)"
SOURCE_ABOUT = "can:can0, slcan:DEVICE, serial:DEVICE or array:ENDPOINT"
DAEMON = given("daemon", "CONFIG|ENDPOINT", DAEMON_ABOUT, nargs="?", default="")
USUAL_SD = (0.02, 0.02, 0.2)

COMMANDS: dict[Run, Arguments] = {
    _init: (
        given("config", "CONFIG", "a new file", Path),
        given("--source", "SOURCE", SOURCE_ABOUT, default=""),
        given("--bundle", "OBJECT", "box, drill, mug or a directory (the skin alone)", default=""),
        given("--layout", "LAYOUT", "the skin's (what the bundle was built for)", default=""),
        given("--poses", "ENDPOINT", "where the robot publishes (no robot)", default=""),
    ),
    _run: (CONFIG, given("--record", "DIR", "also record a session into this new one", Path)),
    _check: (CONFIG,),
    _record: (CONFIG, given("--out", "DIR", "a new directory", Path, required=True)),
    _replay: (
        given("directory", "DIR", "a session", Path),
        given("--config", "CONFIG", "in place of the session's own config.toml", Path),
        given("--seed", "N", "in place of filter.seed", natural),
    ),
    _export: (
        given("session", "SESSION", "its directory", Path),
        given("--out", "DIR", "for the files, which must be new", Path, required=True),
    ),
    _calibrate: (
        given("source", "CONFIG|SESSION", "a skin to be pressed now, or recorded", Path),
        given("--out", "FILE", "*.toml", Path),
        flag("--check", "only judge the session's own full scale and mount by its touches"),
        given("--object", "X Y YAW", "its pose, if known, in the world [m, m, rad]", float),
    ),
    _layout: (given("layout", "LAYOUT", "cylinder:… or wrap:…, or a .json or .csv file"),),
    _status: (DAEMON, flag("--json", "the whole answer as JSON")),
    _tare: (DAEMON,),
    _reset: (DAEMON,),
    _prior: (
        DAEMON,
        given("--at", "X Y YAW", "in the world [m, m, rad]; YAW may be nan", float, required=True),
        given("--sd", "X Y YAW", "standard deviations (0.02 0.02 0.2)", float, default=USUAL_SD),
    ),
    _advise: (
        CONFIG,
        given("--candidates", "FILE", "*.csv: x,y,theta,x1,y1 of each", Path, required=True),
        flag("--json", "a line of JSON for each"),
    ),
    _view: (
        given("source", "CONFIG|ENDPOINT|SESSION", DAEMON_ABOUT, nargs="?", default=""),
        given("--save", "FILE", "into an .rrd file, no window", Path),
        given("--seconds", "S", "of scans, from the first on (all)", float, default=math.inf),
    ),
}


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld",
        "The daemon that turns touches of artificial skin into the pose of a known object, and the "
        "commands beside it.",
        "taxeld check can0.toml",
        "taxeld run can0.toml",
        "taxeld status can0.toml",
    )
    command_line.add_commands(parser, COMMANDS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
