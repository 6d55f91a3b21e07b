"""The commands `view`, `watch` and `advise`."""

import argparse
import math
from pathlib import Path

from taxeld.command_line import FAILED, Commands, add_endpoint, add_keys, documented, stopping
from taxeld.config.endpoints import for_this_user
from taxeld.config.file import load
from taxeld.config.tables import PublishConfig
from taxeld.errors import SetupError


def add(commands: Commands) -> None:
    view = documented(commands, _view)
    about = "of a running daemon, which adds the object's slices, or recorded"
    view.add_argument("source", type=Path, nargs="?", metavar="CONFIG|SESSION", help=about)
    view.add_argument("--endpoint", help="where the daemon publishes")
    add_keys(view)
    about = "of scans to show, from the first on"
    view.add_argument("--seconds", type=float, default=math.inf, metavar="S", help=about)
    where = view.add_mutually_exclusive_group()
    where.add_argument("--save", type=Path, metavar="FILE", help="into an .rrd file, no viewer")
    where.add_argument("--web", action="store_true", help="serve it to a browser of this machine")

    add_endpoint(documented(commands, _watch), "where the daemon publishes")

    advise = documented(commands, _advise)
    add_endpoint(advise, "where the daemon publishes")
    advise.add_argument("--json", action="store_true", help="the message as JSON, one a line")
    advise.add_argument("--follow", action="store_true", help="each new advice, until stopped")


def _view(args: argparse.Namespace) -> int:
    """Show a running daemon or a session in three dimensions, with plots.

    taxeld view
    taxeld view can0.toml
    taxeld view session --save session.rrd
    """
    from taxeld.view import view
    from taxeld.view.stage import recorded, scenes_of

    source = args.source
    if not args.seconds > 0.0:
        raise SetupError("--seconds: must be more than 0")
    target = view.Destination(args.save, args.web, args.seconds, stopping())
    if source is not None and (source.is_dir() or source.suffix != ".toml"):
        if args.endpoint or args.keys:
            raise SetupError("--endpoint, --keys: are for a running daemon, not for a session")
        if not view.show(*recorded(source), target) and not target.stopping():
            raise SetupError(f"{source}: holds no scan to show")
        return 0
    scenes = [] if source is None else scenes_of(load(source))
    return 0 if view.live(_endpoint(args.endpoint, source), args.keys, scenes, target) else FAILED


def _watch(args: argparse.Namespace) -> int:
    """Show what a running daemon feels and believes, in the terminal.

    taxeld watch
    taxeld watch can0.toml
    taxeld watch --endpoint tcp://127.0.0.1:9872
    """
    from taxeld.view.watch import watch

    watch(_endpoint(args.endpoint, args.config), args.keys, stopping())
    return 0


def _advise(args: argparse.Namespace) -> int:
    """Tell where to touch next, as a running daemon advises.

    taxeld advise
    taxeld advise can0.toml --json --follow
    taxeld advise --endpoint tcp://127.0.0.1:9872
    """
    from taxeld.view.advise import advise

    if args.config and not load(args.config).advice.enabled:
        raise SetupError("advice.enabled: is false, so this daemon advises nothing; set it to true")
    where, ends = _endpoint(args.endpoint, args.config), stopping()
    told = advise(where, args.keys, ends, as_json=args.json, follow=args.follow)
    return 0 if told else FAILED


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
