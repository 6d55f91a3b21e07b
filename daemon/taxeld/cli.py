"""`taxeld`: the daemon and the commands beside it."""

import argparse
import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld import command_line
from taxeld.command_line import FAILED, Commands, command, documented
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.gate import ConfigError
from taxeld.config.tables import LEVELS, ControlConfig
from taxeld.errors import SetupError
from taxeld.view import cli as view_cli

DONE = {
    "tare": "the idle baseline is being learned again; leave the skin untouched until it is",
    "prior": "the prior is taken; touches may refute it",
    "reset": "all touches are forgotten",
}
OWN_CONFIG = "in place of the session's own config.toml"


def main(argv: list[str] | None = None) -> int:
    """Run the command line; → 0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    command_line.one_thread()
    if (sys.argv[1:] if argv is None else argv)[:1] == ["relay"]:
        print(
            "relay: is no command any more; 'taxeld run' serves relay.publish and relay.control of "
            "its configuration itself",
            file=sys.stderr,
        )
        return command_line.USAGE_ERROR
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    """Run the daemon until it is stopped.

    taxeld run can0.toml
    taxeld run --record session can0.toml
    """
    # the other commands need neither zmq nor a device
    from taxeld.commands.record import recorder_of
    from taxeld.service import log, signals
    from taxeld.service.loop import Daemon

    with log.written(), signals.Signals() as received:
        config = load(args.config)
        log.set_level(args.log_level or config.log.level)
        recorder = recorder_of(config, args.config, args.record) if args.record else None
        daemon = Daemon(config, recorder)
        received.stop_by(daemon.stop)
        actions: dict[int, Callable[[], None]] = {
            signal.SIGHUP: lambda: signals.reload(args.config, config, args.log_level),
            signal.SIGUSR1: lambda: signals.dump(daemon.publisher.state()),
        }
        daemon.run(lambda: received.serve(actions))
    return 0


def _record(args: argparse.Namespace) -> int:
    """Record what skin and robot send; nothing is estimated.

    taxeld record --out session can0.toml
    """
    from taxeld.commands.record import Recording

    recording = Recording(load(args.config), args.config, args.out)

    def stop(*_: object) -> None:
        recording.stopping = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    print(recording.run())
    return FAILED if recording.failed else 0


def _init(args: argparse.Namespace) -> int:
    """Write a configuration with a comment on each key; asks what is not given as an option.

    taxeld init can0.toml
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
    taxeld check --running /etc/taxeld/can0.toml
    """
    from taxeld.commands import check

    config = load(args.config)
    faults = check.faults(config, args.running)
    if faults:
        raise ConfigError(faults)
    print("\n".join([f"{args.config}: fine", *(f"note: {line}" for line in check.notes(config))]))
    return 0


def _decode(args: argparse.Namespace) -> int:
    """Decode a log of frames; one JSON line for each scan, then one with the counters.

    taxeld decode candump.log
    taxeld decode --config can0.toml session/frames.log
    """
    from taxeld.commands.decode import decode, of_session
    from taxeld.source.module_order import ListedModules

    modules = load(args.config).source.modules if args.config else of_session(args.log)
    listed = ListedModules(modules) if args.config or modules else None
    for line in decode(args.log, listed, args.interface):
        print(line)
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
    """Describe the layout of a skin in words and as a picture.

    taxeld layout cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015 --png skin.png
    taxeld layout skin.json
    """
    from taxeld.commands.layout import next_command, summary
    from taxeld.layout import read as layouts

    skin = layouts.read(args.layout)
    print("\n".join([*summary(skin), *next_command(args.layout, skin)]))
    if args.png:
        from taxeld.layout.draw import draw

        try:
            draw(skin, args.png)
        except OSError as error:
            raise SetupError(f"--png: cannot write {args.png} ({error.strerror})") from None
    return 0


def _ask(args: argparse.Namespace) -> int:
    from taxeld.commands.status import lines
    from taxeld.commands.unanswered import unanswered
    from taxeld.stream import client

    endpoint = args.endpoint or for_this_user(ControlConfig().endpoint)
    if args.config:
        endpoint = load(args.config).control.endpoint
        if not endpoint:
            raise SetupError("control.endpoint: is empty, so this daemon cannot be asked")
    what = _prior(args) if args.name == "prior" else {}
    answer = client.ask(endpoint, args.name, args.keys, **what)
    if answer is None or not answer.get("ok"):
        fault = f"{endpoint}: {(answer or {}).get('error', 'an answer of another kind')}"
        print(unanswered(endpoint) if answer is None else fault, file=sys.stderr)
        return FAILED
    if args.name == "status":
        print(json.dumps(answer, indent=1) if args.json else "\n".join(lines(answer)))
    else:
        print(DONE[args.name])
    return 0


def _advise(args: argparse.Namespace) -> int:
    """Tell where to touch next, by what a running daemon has felt.

    taxeld advise can0.toml
    taxeld advise can0.toml --json --follow
    taxeld advise can0.toml --reach 0.2 0.8 -0.3 0.3
    """
    from taxeld.advice.lines import Reach
    from taxeld.commands import advise

    given = {"box_m": args.reach, "yaw_deg": args.yaw_deg, "directions_deg": args.directions_deg}
    given |= {"clearance_m": args.clearance_m, "depth_m": args.depth_m}
    reach = Reach(**{name: _plain(value) for name, value in given.items() if value is not None})
    config, stopping = load(args.config), command_line.stopping()
    for advice in advise.follow(config, reach, args.keys, stopping):
        say = [advise.as_json(advice, config.names)] if args.json else []
        print("\n".join(say or advise.lines(advice, config.names)), flush=True)
        if not args.follow:
            break
    return 0


def _plain(value: float | list[float]) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _prior(args: argparse.Namespace) -> dict[str, Any]:
    (x, y), (sx, sy, turn) = args.at, args.sd
    found = {"x": x, "y": y, "theta": args.yaw, "cov": [sx, sy, turn]}
    return found | {"weight": args.weight, "object": args.object}


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld",
        "The daemon that turns touches of artificial skin into the pose of a known object, and the "
        "commands beside it.",
        "taxeld check can0.toml",
        "taxeld run can0.toml",
        "taxeld status can0.toml",
    )
    commands = command_line.commands_of(parser)
    _add_daemon(commands)
    _add_sessions(commands)
    _add_skin(commands)
    _add_asking(commands)
    _add_advise(commands)
    view_cli.add(commands)
    return parser


def _add_daemon(commands: Commands) -> None:
    add = documented(commands, _init).add_argument
    add("config", type=Path, metavar="CONFIG", help="a new file")
    add("--source", help="can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0 or array:ENDPOINT")
    add("--bundle", help="the object: box, drill, mug, or what taxeld-train build made")
    add("--no-object", action="store_true", help="the skin alone: contacts, and no estimate")
    add("--layout", help="the skin's (default: what the bundle was built for)")
    about = "where the robot publishes; '' if the sensor is fixed"
    add("--poses", metavar="ENDPOINT", help=about)
    about = "the square, about X Y, where the object can be [m] (default 0 0 0.5)"
    add("--where", nargs=3, metavar=("X", "Y", "HALF"), help=about)
    add("--keys", default="", metavar="DIR", help="keys, where the robot is another machine")

    add = documented(commands, _run).add_argument
    add("config", type=Path, metavar="CONFIG")
    about = "also record a session into this new directory"
    add("--record", type=Path, metavar="DIR", help=about)
    add("--log-level", choices=LEVELS, help="in place of log.level of the configuration")

    add = documented(commands, _check).add_argument
    add("config", type=Path, metavar="CONFIG")
    about = "a daemon runs with this configuration: what it has in use is no fault"
    add("--running", action="store_true", help=about)


def _add_sessions(commands: Commands) -> None:
    add = documented(commands, _record).add_argument
    add("config", type=Path, metavar="CONFIG")
    add("--out", type=Path, required=True, metavar="DIR", help="a new directory")

    add = documented(commands, _replay).add_argument
    add("directory", type=Path, metavar="DIR")
    add("--config", type=Path, help=OWN_CONFIG)
    add("--seed", type=int, help="in place of filter.seed")

    add = documented(commands, _decode).add_argument
    about = "a log of candump or of python-can, or a serial.bin"
    add("log", type=Path, metavar="LOG", help=about)
    about = "with source.modules; a session's log has its own"
    add("--config", type=Path, help=about)
    about = "the skin's CAN interface, where the log holds several"
    add("--interface", default="", help=about)


def _add_skin(commands: Commands) -> None:
    add = documented(commands, _calibrate).add_argument
    about = "a skin to be pressed now, or recorded"
    add("source", type=Path, metavar="CONFIG|SESSION", help=about)
    add("--out", type=Path, metavar="FILE", help="*.toml")
    about = "say whether a session's touches agree with the full scale and mount that it had"
    add("--check", action="store_true", help=about)
    about = "the object's pose in the robot's world [m, m, rad]; without it, found by touch"
    add("--object", type=float, nargs=3, metavar=("X", "Y", "YAW"), help=about)
    add("--config", type=Path, help=OWN_CONFIG)
    about = "number of presses to ask for (default %(default)s)"
    add("--presses", type=int, default=20, metavar="N", help=about)
    about = "seconds without touch at the start (default %(default)s)"
    add("--idle-s", type=float, default=60.0, help=about)

    add = documented(commands, _layout).add_argument
    add("layout", metavar="LAYOUT", help="cylinder:… or wrap:…, or a .json or .csv file")
    add("--png", type=Path, metavar="OUT", help="draw it, unrolled and cut across")


def _add_advise(commands: Commands) -> None:
    made = documented(commands, _advise)
    add = made.add_argument
    add("config", type=Path, metavar="CONFIG", help="the daemon's configuration")
    add("--json", action="store_true", help="one line of JSON for each advice")
    add("--follow", action="store_true", help="again whenever more was felt, until stopped")
    about = "where the sensor can be in the world [m]; without it, the filter's square"
    add("--reach", type=float, nargs=4, metavar=("X", "X", "Y", "Y"), help=about)
    about = "directions of motion in the world (default: 24 all around)"
    add("--directions-deg", type=float, nargs="+", metavar="D", help=about)
    add("--yaw-deg", type=float, nargs=2, metavar=("LEAST", "MOST"), help="yaw of the sensor")
    about = "approaches begin so far from wherever the object may be"
    add("--clearance-m", type=float, metavar="M", help=about)
    add("--depth-m", type=float, metavar="M", help="how far to go on once something is touched")
    command_line.add_keys(made)


def _add_asking(commands: Commands) -> None:
    for name, text in (
        ("status", "Show what a running daemon believes and counts."),
        ("tare", "Have a running daemon learn the idle baseline again; do not touch the skin."),
        ("reset", "Have a running daemon forget all touches."),
        ("prior", "Tell a running daemon where the object may be."),
    ):
        at = " --at 0.4 0.1" if name == "prior" else ""
        endings = "", " can0.toml", " --endpoint ipc:///run/taxeld/control"
        examples = (f"taxeld {name}{ending}{at}" for ending in endings)
        ask = command(commands, name, text, *examples, run=_ask)
        command_line.add_endpoint(ask, "a control endpoint of the daemon")
        if name == "prior":
            add = ask.add_argument
            about = "of the object in the world [m]"
            add("--at", nargs=2, type=float, required=True, metavar=("X", "Y"), help=about)
            add("--yaw", type=float, help="[rad]; without it X Y are of the object's middle")
            about = "standard deviations [m, m, rad] (default 0.02 0.02 0.2)"
            deviations = ("SX", "SY", "SYAW")
            usual = (0.02, 0.02, 0.2)
            add("--sd", nargs=3, type=float, default=usual, metavar=deviations, help=about)
            add("--weight", type=float, help="probability that it means this object (default 0.9)")
            add("--object", help="name, where several may be felt")
        if name == "status":
            ask.add_argument("--json", action="store_true", help="the whole answer as JSON")
        ask.set_defaults(name=name)


if __name__ == "__main__":
    sys.exit(main())
