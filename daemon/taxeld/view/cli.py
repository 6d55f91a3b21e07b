"""The command `view`."""

import argparse
import math
import sys
from itertools import chain
from pathlib import Path

from taxeld.command_line import FAILED, Commands, add_keys, documented, stopping
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import PublishConfig
from taxeld.errors import SetupError


def add(commands: Commands) -> None:
    view = documented(commands, _view)
    about = "of a running daemon, or recorded"
    view.add_argument("source", type=Path, nargs="?", metavar="CONFIG|SESSION", help=about)
    view.add_argument("--endpoint", help="where the daemon publishes")
    add_keys(view)
    about = "of scans to show, from the first on"
    view.add_argument("--seconds", type=float, default=math.inf, metavar="S", help=about)
    view.add_argument("--save", type=Path, metavar="FILE", help="into an .rrd file, no window")


def _view(args: argparse.Namespace) -> int:
    """Show a running daemon or a session in three dimensions, with plots.

    taxeld view
    taxeld view can0.toml --save live.rrd --seconds 60
    taxeld view session
    """
    from taxeld.commands.unanswered import unanswered
    from taxeld.view import view
    from taxeld.view.picture import Picture

    source, ends = args.source, stopping()
    if not args.seconds > 0.0:
        raise SetupError("--seconds: must be more than 0")
    if source is not None and (source.is_dir() or source.suffix != ".toml"):
        if args.endpoint or args.keys:
            raise SetupError("--endpoint, --keys: are for a running daemon, not for a session")
        picture, heard = view.recorded(source)
    else:
        where = _endpoint(args.endpoint, source)
        picture, heard = Picture(), view.live(where, args.keys, ends)
        first = next(heard, None)
        if first is None:
            print("stopped" if ends() else unanswered(where), file=sys.stderr)
            return FAILED
        heard = chain([first], heard)
    begun = view.begun(heard, args.seconds, ends)
    if args.save is None:
        view.show(picture, begun, ends)
    else:
        view.save(picture, begun, args.save)
        print(f"written: {args.save}; see it with: rerun {args.save}")
    return 0


def _endpoint(named: str | None, config: Path | None) -> str:
    """Where to subscribe: as named, as configured, or the service's own."""
    if named:
        return named
    if config is None:
        return for_this_user(PublishConfig().endpoints[0])
    served = load(config).publish.endpoints
    if not served:
        raise SetupError("publish.endpoints: is empty, so nobody can subscribe to this daemon")
    return served[0]
