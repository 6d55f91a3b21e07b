"""The commands of this room: their arguments, and what they run."""

import argparse
import math
import signal
from collections.abc import Callable
from pathlib import Path

from taxeld.command_line import FAILED, Commands, command
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import PublishConfig
from taxeld.errors import SetupError


def add(commands: Commands) -> None:
    """`view`, `watch` and `export`."""
    view = command(
        commands, "view", "Show a running daemon or a session in three dimensions, with plots.",
        "taxeld view", "taxeld view can0.toml", "taxeld view session --save session.rrd",
        run=_view,
    )  # fmt: skip
    view.add_argument(
        "source", type=Path, nargs="?", metavar="CONFIG|SESSION",
        help="of a running daemon, which adds the object's slices, or recorded",
    )  # fmt: skip
    view.add_argument("--endpoint", help="where the daemon or its relay publishes")
    view.add_argument(
        "--keys", type=Path, metavar="DIR", help="with server.key and client.key_secret"
    )
    view.add_argument(
        "--truth", type=float, nargs=3, metavar=("X", "Y", "YAW"),
        help="where the object stands [m, m, rad], for its error; needs CONFIG",
    )  # fmt: skip
    view.add_argument(
        "--seconds",
        type=float,
        default=math.inf,
        metavar="S",
        help="so long alone, from the first scan",
    )
    where = view.add_mutually_exclusive_group()
    where.add_argument("--save", type=Path, metavar="FILE", help="into an .rrd file, no viewer")
    where.add_argument("--web", action="store_true", help="serve it to a browser of this machine")

    watch = command(
        commands, "watch", "Show what a running daemon feels and believes, in the terminal.",
        "taxeld watch", "taxeld watch can0.toml",
        "taxeld watch --endpoint tcp://127.0.0.1:9872", run=_watch,
    )  # fmt: skip
    _add_endpoint(watch)

    export = command(
        commands, "export", "Write a session as ROS 2 messages, for Foxglove and 'ros2 bag'.",
        "taxeld export session --mcap session.mcap", run=_export,
    )  # fmt: skip
    export.add_argument("session", type=Path, metavar="SESSION")
    export.add_argument("--mcap", type=Path, required=True, metavar="FILE", help="to be written")
    export.add_argument("--config", type=Path, help="in place of the session's own config.toml")


def _add_endpoint(parser: argparse.ArgumentParser) -> None:
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "config", type=Path, nargs="?", metavar="CONFIG", help="the daemon's configuration"
    )
    where.add_argument("--endpoint", help="where the daemon or its relay publishes")
    parser.add_argument(
        "--keys", type=Path, metavar="DIR", help="with server.key and client.key_secret"
    )


def _view(args: argparse.Namespace) -> int:
    import numpy as np

    from taxeld.view import view
    from taxeld.view.stage import from_config

    def say(line: str) -> None:
        print(line, flush=True)

    source, truth = args.source, args.truth and np.array(args.truth)
    if not args.seconds > 0.0:
        raise SetupError("--seconds: must be more than 0")
    shown = view.Shown(args.save, args.web, args.seconds, _stopping(), say)
    if source is not None and (source.is_dir() or source.suffix != ".toml"):
        if args.endpoint or args.keys or args.truth:
            raise SetupError(
                "--endpoint, --keys, --truth: are for a running daemon, not for a session"
            )
        view.recorded(source, shown)
        return 0
    if truth is not None and source is None:
        raise SetupError("--truth: needs CONFIG, which names the object")
    known = None if source is None else from_config(load(source), truth)
    args.config = source
    return 0 if view.live(_endpoint(args), args.keys, known, shown) else FAILED


def _watch(args: argparse.Namespace) -> int:
    from taxeld.view.watch import watch

    watch(_endpoint(args), args.keys, _stopping())
    return 0


def _stopping() -> Callable[[], bool]:
    """What tells whether a signal asked for the end."""
    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _: stopped.append(got))
    return lambda: bool(stopped)


def _export(args: argparse.Namespace) -> int:
    from taxeld.view.export import export

    written = export(args.session, args.mcap, args.config)
    print("\n".join([f"written: {args.mcap}", *(f"{n:8d}  {t}" for t, n in written.items())]))
    return 0


def _endpoint(args: argparse.Namespace) -> str:
    """Where to subscribe: as named, as configured, or the service's own."""
    if args.endpoint:
        return str(args.endpoint)
    if args.config is None:
        return for_this_user(PublishConfig().endpoints[0])
    served = load(args.config).publish.endpoints
    if not served:
        raise SetupError("publish.endpoints: is empty, so nobody can subscribe to this daemon")
    return served[0]
