"""The commands of this room: their arguments, and what they run."""

import argparse
import signal
from pathlib import Path

from taxeld.command_line import Commands, command
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import PublishConfig
from taxeld.errors import SetupError


def add(commands: Commands) -> None:
    """`watch` and `export`."""
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


def _watch(args: argparse.Namespace) -> int:
    from taxeld.view.watch import watch

    stopped: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _: stopped.append(got))
    watch(_endpoint(args), args.keys, lambda: bool(stopped))
    return 0


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
