"""`taxeld-train`: the offline commands."""

import argparse
import math
import sys
import time
from importlib import import_module
from pathlib import Path

from taxeld import command_line
from taxeld.command_line import documented
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import options
from taxeld_hil.objects import HEIGHT_M
from taxeld_training.objects import DEPTH_MAX_M

EXPERIMENTS = {  # name → module, and the function in it that writes rows
    "whole": ("filters.whole", "whole_rows"),
    "works": ("filters.works", "work_rows"),
    "stability": ("filters.stability", "stability_rows"),
    "reliability": ("filters.reliability", "reliability_rows"),
    "recognise": ("filters.recognise", "recognise_rows"),
    "links": ("filters.linked", "link_rows"),
    "advice": ("filters.advised", "advice_rows"),
    "push": ("filters.push", "push_rows"),
}
UNCELLED = ("push", "recognise", "links")  # of no chosen cells


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments."""
    return command_line.main(_parser(), argv, "taxeld-train: ")


def _build(args: argparse.Namespace) -> int:
    """Build what the daemon needs of an object and a skin, or a bundle of each of several.

    taxeld-train build 025_mug --out mug
    taxeld-train build bracket.stl --layout skin.json --height-m 0.05 --quick --out bracket
    taxeld-train build 003_cracker_box 025_mug 035_power_drill --out bank
    """
    from taxeld_training import commands

    for line in commands.build(args):
        print(line)
    return 0


def _seal(args: argparse.Namespace) -> int:
    """Write the digests of a bundle's files into it, as they are now.

    taxeld-train seal bracket
    """
    from taxeld_hil.objects import bundles

    bundles.seal(args.bundle)
    print(f"{args.bundle}: sealed")
    return 0


def _scene(args: argparse.Namespace) -> int:
    """Show what the skin meets of an object, before a bundle is built.

    taxeld-train scene 025_mug
    taxeld-train scene bracket.stl --height-m 0.05 --png bracket.png
    """
    from taxeld_training import commands

    for line in commands.scene(args):
        print(line)
    return 0


def _evaluate(args: argparse.Namespace) -> int:
    """Run an experiment; it writes JSON and pictures.

    taxeld-train evaluate works --quick --out results
    """
    from taxeld_training.jobs.options import Options

    if args.cells and args.experiment in UNCELLED:
        raise SetupError(f"--cells: {args.experiment} has no cells to choose from")
    given = {k: v for k, v in vars(args).items() if k in Options.__dataclass_fields__}
    given["layouts"] = _layouts(args)
    module, rows = EXPERIMENTS[args.experiment]
    run = getattr(import_module(f"taxeld_training.{module}"), rows)
    for path in run(Options(**given, until=time.monotonic() + 60.0 * args.minutes)):
        print(path)
    return 0


def _layouts(args: argparse.Namespace) -> tuple[str, ...]:
    """Raises SetupError where a layout cannot be read, or the experiment has no room for it."""
    from taxeld.layout import read as layouts

    found = tuple(options.layouts(args.layout))
    if args.experiment == "recognise" and len(found) > 1:
        raise SetupError("--layout: recognise has room for one; run it for each")
    if args.experiment == "push" and found != ("",):
        raise SetupError("--layout: push is of the shipped bundles' own layout")
    for spec in filter(None, found):
        layouts.load(spec)
    return found


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-train",
        "Make what the daemon needs of an object, and run the experiments.",
        "taxeld-train scene bracket.stl --height-m 0.05",
        "taxeld-train build bracket.stl --height-m 0.05 --out bracket",
    )
    commands = command_line.commands_of(parser)
    add = _with_object(documented(commands, _scene)).add_argument
    about = "draw the object, the skin's heights and the slices"
    add("--png", type=Path, metavar="OUT", help=about)
    add = _with_object(documented(commands, _build), nargs="+").add_argument
    about = "directory of the bundle; of several objects, the directory that holds theirs"
    add("--out", type=Path, required=True, metavar="BUNDLE", help=about)
    about = "also of several objects; without them the table of simulated contacts proposes poses"
    add("--samplers", action="store_true", help=about)
    about = "in a minute, with poor samplers: other defaults for the options below"
    add("--quick", action="store_true", help=about)
    about = "share of each model's full training (default 1)"
    add("--effort", type=float, metavar="SHARE", help=about)
    add("--contacts", type=int, help="simulated contacts to train on (default 300000)")
    add("--bank", type=int, help="contacts that exact posteriors begin with")
    add("--readings", type=int, help="readings that samplers are measured on")
    add("--trials", type=int, help="trials at the end (default 40)")
    about = "of these trials: exact, typical or poor (default %(default)s)"
    add("--foam", default="typical", help=about)
    add("--ddpm", action="store_true", help="also the diffusion, a baseline; takes twice as long")
    add("--seed", type=int, default=0)
    documented(commands, _seal).add_argument("bundle", type=Path, metavar="BUNDLE")
    _add_options(documented(commands, _evaluate))
    return parser


class _OneALink(argparse.Action):
    """An option that may be given for each link: what follows the first is kept apart."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,  # noqa: ARG002
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,  # noqa: ARG002
    ) -> None:
        more = f"{self.dest}_more"
        if hasattr(namespace, more):
            getattr(namespace, more).append(values)
        else:
            setattr(namespace, self.dest, values)
            setattr(namespace, more, [])


def _with_object(one: argparse.ArgumentParser, nargs: str | None = None) -> argparse.ArgumentParser:
    action = "store" if nargs is None else _OneALink
    add = one.add_argument
    about = "a YCB id (025_mug), or a mesh file in metres whose z axis points up"
    add("object", metavar="OBJECT", nargs=nargs, help=about)
    about = "as skin.layout in the configuration (default %(default)s)"
    about += "" if nargs is None else "; again for each further link"
    add("--layout", "--skin", action=action, default=SkinConfig().layout, help=about)
    about = "the sensor frame's origin above the object's lowest point (default %(default)s)"
    add("--height-m", action=action, type=float, default=HEIGHT_M, metavar="H", help=about)
    about = "depth of a press at full scale (default %(default)g)"
    add("--depth-mm", type=float, default=1e3 * DEPTH_MAX_M, metavar="D", help=about)
    return one


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, text.split(",")))


def _add_options(one: argparse.ArgumentParser) -> None:
    add = one.add_argument
    add("experiment", choices=tuple(EXPERIMENTS))
    add("--out", type=Path, default=Path("docs/results"), metavar="DIR")
    options.add_jobs(one)
    add("--quick", action="store_true", help="a smoke run; its figures mean nothing")
    about = "default: box and mug; of whole, works, recognise and advice the ten"
    add("--objects", type=_names, default=(), metavar="A,B", help=about)
    options.add_layouts(one, "rings of 5 rows")
    about = "filters by their proposal (table, shipped, …), or guides of advice"
    add("--groups", type=_names, default=(), metavar="A,B", help=about)
    about = "conditions: factors (noise, skin, 'wrong object', …) or a level of one (moved=5)"
    add("--cells", type=_names, default=(), metavar="A,B", help=about)
    add("--effort", type=float, default=1.0, metavar="SHARE", help="of a model's own training")
    add("--seeds", type=int, default=0, metavar="N", help="trials a cell of a filter experiment")
    add("--minutes", type=float, default=math.inf, help="begin nothing later; write what is done")
    add("--seed", type=int, default=0)


if __name__ == "__main__":
    sys.exit(main())
