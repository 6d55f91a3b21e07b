"""`taxeld`: the daemon and the commands beside it."""

import argparse
import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from taxeld import command_line
from taxeld.command_line import FAILED, command
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import LEVELS, ControlConfig
from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError
from taxeld.view import cli as view_cli

DONE = {
    "tare": "the idle baseline is being learned again; leave the skin untouched until it is",
    "reset": "all touches are forgotten",
}


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
            signal.SIGUSR1: lambda: signals.dump(daemon.state()),
        }
        daemon.run(lambda: received.serve(actions))
    if args.histogram:
        _write(args.histogram, json.dumps(daemon.latencies.as_cyclictest(), indent=1) + "\n")
    return 0


def _record(args: argparse.Namespace) -> int:
    from taxeld.commands.record import Recording

    recording = Recording(load(args.config), args.config, args.out)

    def stop(*_: object) -> None:
        recording.stopping = True

    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, stop)
    print(recording.run())
    return FAILED if recording.failed else 0


def _init(args: argparse.Namespace) -> int:
    from taxeld.commands import init

    answers = init.Answers(
        args.source, args.bundle, args.layout, args.poses, args.dialect, args.keys
    )
    config = init.write(args.config, answers, init.person())
    print(f"written: {args.config} ({config.source.kind} {config.source.channel}, object "
          f"{config.scene.bundle}); next: taxeld check {args.config}")  # fmt: skip
    return 0


def _check(args: argparse.Namespace) -> int:
    from taxeld.commands import check

    config = load(args.config)
    faults = check.faults(config, args.running)
    if faults:
        raise ConfigError(faults)
    print("\n".join([f"{args.config}: fine", *(f"note: {line}" for line in check.notes(config))]))
    return 0


def _decode(args: argparse.Namespace) -> int:
    from taxeld.commands.decode import decode
    from taxeld.layout import read as layouts
    from taxeld.source import module_order

    listed = None
    if args.config:
        config = load(args.config)
        listed = module_order.given(config.source, layouts.read(config.skin.layout))
    for line in decode(args.log, listed, args.dialect, args.interface):
        print(line)
    return 0


def _replay(args: argparse.Namespace) -> int:
    from taxeld.commands.replay import replay
    from taxeld.source import session

    config = load(args.config or args.directory / session.CONFIG)
    for line in replay(args.directory, config, args.seed):
        print(line)
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    """Run the harness's calibration, which it registers in the entry-point group
    `taxeld.commands`."""
    from importlib.metadata import entry_points

    for entry in entry_points(group="taxeld.commands", name="calibrate"):
        return int(entry.load()(args))
    raise SetupError("calibrate: taxeld is not installed here; pip install 'taxeld[calibrate]'")


def _layout(args: argparse.Namespace) -> int:
    from taxeld.commands.layout import summary
    from taxeld.layout import read as layouts

    skin = layouts.read(args.layout)
    print("\n".join(summary(skin)))
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
    answer = client.ask(endpoint, args.name, args.keys)
    if answer is None:
        print(unanswered(endpoint), file=sys.stderr)
        return FAILED
    if not answer.get("ok"):
        print(f"{endpoint}: {answer.get('error', 'an answer of another kind')}", file=sys.stderr)
        return FAILED
    if args.name == "status":
        print(json.dumps(answer, indent=1) if args.json else "\n".join(lines(answer)))
    else:
        print(DONE[args.name])
    return 0


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise SetupError(f"cannot write {path} ({error.strerror})") from None


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld",
        "The daemon that turns touches of artificial skin into the pose of a known object, and the "
        "commands beside it.",
        "taxeld check can0.toml", "taxeld run can0.toml", "taxeld status can0.toml",
    )  # fmt: skip
    commands = command_line.commands_of(parser)
    _add_daemon(commands)
    _add_sessions(commands)
    _add_skin(commands)
    _add_asking(commands)
    view_cli.add(commands)
    return parser


def _add_daemon(commands: command_line.Commands) -> None:
    init = command(
        commands, "init",
        "Write a configuration with a comment on each key; asks what is not given as an option.",
        "taxeld init can0.toml",
        "taxeld init can0.toml --source can:can0 --bundle box --poses tcp://127.0.0.1:9874",
        run=_init,
    )  # fmt: skip
    init.add_argument("config", type=Path, metavar="CONFIG", help="a new file")
    init.add_argument("--source", help="can:can0, slcan:/dev/ttyACM0 or serial:/dev/ttyACM0")
    init.add_argument("--bundle", help="the object: box, mug, or what taxeld-train build made")
    init.add_argument("--layout", help="the skin's (default: what the bundle was built for)")
    init.add_argument(
        "--poses", metavar="ENDPOINT", help="where the robot publishes; '' if the sensor is fixed"
    )
    init.add_argument("--dialect", choices=["cyskin", "icub"], default="cyskin")
    init.add_argument(
        "--keys", default="", metavar="DIR", help="keys, where the robot is another machine"
    )

    run = command(
        commands, "run", "Run the daemon until it is stopped.",
        "taxeld run can0.toml", "taxeld run --record session can0.toml", run=_run,
    )  # fmt: skip
    run.add_argument("config", type=Path, metavar="CONFIG")
    run.add_argument(
        "--histogram",
        type=Path,
        metavar="FILE",
        help="write a histogram of the latencies at the end",
    )
    run.add_argument(
        "--record", type=Path, metavar="DIR", help="also record a session into this new directory"
    )
    _add_log_level(run)

    check = command(
        commands, "check", "Check everything that a run needs; one line for each fault.",
        "taxeld check can0.toml", "taxeld check --running /etc/taxeld/can0.toml", run=_check,
    )  # fmt: skip
    check.add_argument("config", type=Path, metavar="CONFIG")
    check.add_argument(
        "--running", action="store_true",
        help="a daemon runs with this configuration: what it has in use is no fault",
    )  # fmt: skip


def _add_log_level(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--log-level", choices=LEVELS, help="in place of log.level of the configuration"
    )


def _add_sessions(commands: command_line.Commands) -> None:
    record = command(
        commands, "record", "Record what skin and robot send; nothing is estimated.",
        "taxeld record --out session can0.toml", run=_record,
    )  # fmt: skip
    record.add_argument("config", type=Path, metavar="CONFIG")
    record.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new directory")

    replay = command(
        commands, "replay", "Estimate from a recorded session; one JSON line for each estimate.",
        "taxeld replay session > estimates.jsonl", run=_replay,
    )  # fmt: skip
    replay.add_argument("directory", type=Path, metavar="DIR")
    replay.add_argument("--config", type=Path, help="in place of the session's own config.toml")
    replay.add_argument("--seed", type=int, help="in place of filter.seed")

    decode = command(
        commands, "decode",
        "Decode a log of frames; one JSON line for each scan, then one with the counters.",
        "taxeld decode candump.log", "taxeld decode --config can0.toml session/frames.log",
        run=_decode,
    )  # fmt: skip
    decode.add_argument(
        "log", type=Path, metavar="LOG", help="a log of candump or of python-can, or a serial.bin"
    )
    decode.add_argument("--dialect", choices=["cyskin", "icub"], default="cyskin")
    decode.add_argument(
        "--config", type=Path, help="take the module table from source.modules of this file"
    )
    decode.add_argument(
        "--interface", default="", help="the skin's CAN interface, where the log holds several"
    )


def _add_skin(commands: command_line.Commands) -> None:
    calibrate = command(
        commands, "calibrate",
        "Measure full scale, gains, noise and mount of a skin from presses on a fixed object.",
        "taxeld calibrate can0.toml --out skin.toml",
        "taxeld calibrate session --out skin.toml --object 0.40 0.10 1.57",
        run=_calibrate,
    )  # fmt: skip
    calibrate.add_argument(
        "source", type=Path, metavar="CONFIG|SESSION", help="a skin to be pressed now, or recorded"
    )
    calibrate.add_argument("--out", type=Path, required=True, metavar="FILE", help="*.toml")
    calibrate.add_argument(
        "--object", type=float, nargs=3, metavar=("X", "Y", "YAW"),
        help="the object's pose in the robot's world [m, m, rad]; without it, found by touch",
    )  # fmt: skip
    calibrate.add_argument("--config", type=Path, help="in place of the session's own config.toml")
    calibrate.add_argument(
        "--presses",
        type=int,
        default=20,
        metavar="N",
        help="number of presses to ask for (default %(default)s)",
    )
    calibrate.add_argument(
        "--idle-s", type=float, default=60.0,
        help="seconds without touch at the start (default %(default)s)",
    )  # fmt: skip

    skin = command(
        commands, "layout", "Describe the layout of a skin in words and as a picture.",
        "taxeld layout cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015 --png skin.png",
        "taxeld layout skin.json", run=_layout,
    )  # fmt: skip
    skin.add_argument(
        "layout", metavar="LAYOUT", help="cylinder:… or wrap:…, a .json or a .txt file"
    )
    skin.add_argument("--png", type=Path, metavar="OUT", help="draw it, unrolled and cut across")


def _add_asking(commands: command_line.Commands) -> None:
    for name, text in (
        ("status", "Show what a running daemon believes and counts."),
        ("tare", "Have a running daemon learn the idle baseline again; do not touch the skin."),
        ("reset", "Have a running daemon forget all touches."),
    ):
        ask = command(
            commands, name, text,
            f"taxeld {name}", f"taxeld {name} can0.toml",
            f"taxeld {name} --endpoint ipc:///run/taxeld/control", run=_ask,
        )  # fmt: skip
        where = ask.add_mutually_exclusive_group()
        where.add_argument(
            "config", type=Path, nargs="?", metavar="CONFIG", help="the daemon's configuration"
        )
        where.add_argument("--endpoint", help="a control endpoint of the daemon")
        ask.add_argument(
            "--keys", type=Path, metavar="DIR", help="with server.key and client.key_secret"
        )
        if name == "status":
            ask.add_argument("--json", action="store_true", help="the whole answer as JSON")
        ask.set_defaults(name=name)


if __name__ == "__main__":
    sys.exit(main())
