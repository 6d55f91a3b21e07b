"""`taxeld`: the daemon and the commands beside it."""

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path

from taxeld import __version__
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import ControlConfig
from taxeld.config.toml_tables import ConfigError
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.source import session

USAGE_ERROR, FAILED = 2, 1
DONE = {
    "tare": "the idle baseline is being learned anew; leave the skin untouched until it is",
    "reset": "all touches are forgotten",
}


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    args = _parser().parse_args(argv)
    try:
        return int(args.command(args))
    except ConfigError as error:
        print("\n".join(error.faults), file=sys.stderr)
        return USAGE_ERROR
    except SetupError as error:
        print(error, file=sys.stderr)
        return USAGE_ERROR
    except BrokenPipeError:  # the reader of our output has gone: `taxeld decode LOG | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _run(args: argparse.Namespace) -> int:
    # the other commands need neither zmq nor a device
    from taxeld.commands.record import recorder_of
    from taxeld.service import descriptors, log, signals
    from taxeld.service.loop import Daemon

    with log.written(), signals.Signals() as received:
        descriptors.ensure()
        config = load(args.config)
        log.set_level(config.log.level)
        recorder = recorder_of(config, args.config, args.record) if args.record else None
        daemon = Daemon(config, recorder)
        received.stop_by(daemon.stop)
        actions: dict[int, Callable[[], None]] = {
            signal.SIGHUP: lambda: signals.reload(args.config, config),
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


def _relay(args: argparse.Namespace) -> int:
    from taxeld.commands.relay import Relay
    from taxeld.service import descriptors, log, signals

    with log.written(), signals.Signals() as received:
        descriptors.ensure()
        config = load(args.config)
        log.set_level(config.log.level)
        relay = Relay(config)
        received.stop_by(relay.stop)
        reload: dict[int, Callable[[], None]] = {
            signal.SIGHUP: lambda: signals.reload(args.config, config)
        }
        try:
            relay.run(lambda: received.serve(reload))
        except SetupError as error:  # at work, where another start may help
            print(error, file=sys.stderr)
            return FAILED
    return 0


def _check(args: argparse.Namespace) -> int:
    from taxeld.commands import check

    config = load(args.config)
    faults = check.faults(config)
    if faults:
        raise ConfigError(faults)
    print("\n".join([f"{args.config}: fine", *(f"note: {line}" for line in check.notes(config))]))
    return 0


def _decode(args: argparse.Namespace) -> int:
    from taxeld.commands.decode import decode
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

    config = load(args.config or args.directory / session.CONFIG)
    for line in replay(args.directory, config, args.seed):
        print(line)
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    import numpy as np

    from taxeld.commands.calibrate import calibrate
    from taxeld.commands.calibration_text import lines

    def say(line: str) -> None:
        print(line, flush=True)

    placed = None if args.object is None else np.array(args.object)
    directory, config_path = args.source, args.config
    if directory.is_dir():
        config = load(config_path or directory / session.CONFIG)
    else:
        from taxeld.commands.calibrate_guided import Guided

        if config_path:
            raise SetupError("--config: is for a session; a running skin has its own")
        config = load(directory)
        directory = Guided.place(args.out)
        guided = Guided(config, args.source, directory, args.idle_s, args.presses, say)
        signal.signal(signal.SIGTERM, lambda *_: guided.stop())
        signal.signal(signal.SIGINT, lambda *_: guided.stop())
        if not guided.run():
            return FAILED
        signal.signal(signal.SIGINT, signal.default_int_handler)
    result = calibrate(directory, config, args.out, placed, say)
    print("\n".join([*lines(result), f"written: {args.out}, and beside it a text and a picture"]))
    return 0


def _layout(args: argparse.Namespace) -> int:
    from taxeld.layout.summary import summary

    skin = layouts.read(args.layout)
    print("\n".join(summary(skin)))
    if args.png:
        try:
            from taxeld.layout.draw import draw
        except ImportError as error:
            raise SetupError(f"--png: {error}; pip install 'taxeld[view]'") from None
        try:
            draw(skin, args.png)
        except OSError as error:
            raise SetupError(f"--png: cannot write {args.png} ({error.strerror})") from None
    return 0


def _ask(args: argparse.Namespace) -> int:
    from taxeld.commands.status import lines
    from taxeld.stream import client

    endpoint = args.endpoint or for_this_user(ControlConfig().endpoint)
    if args.config:
        endpoint = load(args.config).control.endpoint
        if not endpoint:
            raise SetupError("control.endpoint: is empty, so this daemon cannot be asked")
    answer = client.ask(endpoint, args.name, args.keys)
    if answer is None:
        print(f"no daemon answers at {endpoint}; is 'taxeld run' there?", file=sys.stderr)
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
    parser = argparse.ArgumentParser(prog="taxeld", description=__doc__)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="the daemon")
    run.add_argument("config", type=Path, metavar="CONFIG")
    run.add_argument("--histogram", type=Path, metavar="FILE", help="latencies, when it ends")
    run.add_argument("--record", type=Path, metavar="DIR", help="a session, beside estimates")
    run.set_defaults(command=_run)

    record = commands.add_parser("record", help="what skin and robot send → a session")
    record.add_argument("config", type=Path, metavar="CONFIG")
    record.add_argument("--out", type=Path, required=True, metavar="DIR")
    record.set_defaults(command=_record)

    relay = commands.add_parser("relay", help="a daemon's streams over TCP")
    relay.add_argument("config", type=Path, metavar="CONFIG", help="the daemon's")
    relay.set_defaults(command=_relay)

    check = commands.add_parser("check", help="validate all that a run needs")
    check.add_argument("config", type=Path, metavar="CONFIG")
    check.set_defaults(command=_check)

    decode = commands.add_parser("decode", help="a log → a JSON line a scan, then counters")
    decode.add_argument("log", type=Path, metavar="LOG", help="of candump and others, serial.bin")
    decode.add_argument("--dialect", choices=["cyskin", "icub"], default="cyskin")
    decode.add_argument("--config", type=Path, help="whose source.modules is the module table")
    decode.add_argument("--interface", default="", help="of a log of several: the skin's")
    decode.set_defaults(command=_decode)

    replay = commands.add_parser("replay", help="session → a JSON line an estimate")
    replay.add_argument("directory", type=Path, metavar="DIR")
    replay.add_argument("--config", type=Path, help="instead of the session's own config.toml")
    replay.add_argument("--seed", type=int, help="instead of the configured one")
    replay.set_defaults(command=_replay)

    calibrate = commands.add_parser(
        "calibrate", help="full scale, gains, noise and mount of a skin, from presses"
    )
    calibrate.add_argument(
        "source", type=Path, metavar="CONFIG|SESSION", help="a skin to be pressed now, or recorded"
    )
    calibrate.add_argument("--out", type=Path, required=True, metavar="FILE", help="*.toml")
    calibrate.add_argument(
        "--object", type=float, nargs=3, metavar=("X", "Y", "YAW"),
        help="its pose in the robot's world [m, m, rad]; else it is found by touch",
    )  # fmt: skip
    calibrate.add_argument("--config", type=Path, help="instead of the session's own config.toml")
    calibrate.add_argument("--presses", type=int, default=20, metavar="N", help="to ask for")
    calibrate.add_argument("--idle-s", type=float, default=60.0, help="untouched, at the start")
    calibrate.set_defaults(command=_calibrate)

    skin = commands.add_parser("layout", help="what a skin's layout is, in words and as a picture")
    skin.add_argument("layout", metavar="LAYOUT", help="cylinder:…, wrap:…, a .json or a .txt")
    skin.add_argument("--png", type=Path, metavar="OUT", help="draw it, unrolled and cut across")
    skin.set_defaults(command=_layout)

    for name, text in (
        ("status", "what a running daemon believes and counts"),
        ("tare", "learn the idle baseline of an untouched skin anew"),
        ("reset", "forget all touches"),
    ):
        ask = commands.add_parser(name, help=text)
        where = ask.add_mutually_exclusive_group()
        where.add_argument("config", type=Path, nargs="?", metavar="CONFIG", help="the daemon's")
        where.add_argument("--endpoint", help="the daemon's, or its relay's")
        ask.add_argument("--keys", type=Path, metavar="DIR", help="server.key, client.key_secret")
        if name == "status":
            ask.add_argument("--json", action="store_true", help="all of it, as it came")
        ask.set_defaults(command=_ask, name=name)
    return parser


if __name__ == "__main__":
    sys.exit(main())
