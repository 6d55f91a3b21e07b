"""`taxeld-train`: the offline commands."""

import argparse
import re
import sys
from pathlib import Path

from taxeld import command_line
from taxeld.command_line import documented
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import options
from taxeld_hil.objects import HEIGHT_M
from taxeld_training.objects import DEPTH_MAX_M

QUESTIONS = "works, whole, map, which, advice, push, samplers"


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
    """Answer questions by simulated trials: tables, JSON and pictures.

    taxeld-train evaluate works --quick --out results
    taxeld-train evaluate map --cells moved,robot --objects 025_mug --out results
    """
    from taxeld_training.trials import run
    from taxeld_training.trials.questions import Asked, names

    layouts = tuple(options.layouts(args.layout))
    asked = Asked(args.quick, _seeds(args.seeds), args.objects, args.cells, layouts)
    workers = run.Workers(args.workers, args.memory)
    for line in run.answer(args.question or names(), asked, workers, args.out):
        print(line, flush=True)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-train",
        "Make what the daemon needs of an object, and answer questions by trials.",
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


def _seeds(text: str) -> tuple[int, ...]:
    """40: the first so many; 40-79: from the one to the other; empty: none. Raises SetupError."""
    if not text:
        return ()
    if named := re.fullmatch(r"(?:(\d+)-)?(\d+)", text):
        first, last = named.groups()
        if found := tuple(range(int(first), int(last) + 1) if first else range(int(last))):
            return found
    raise SetupError(f"--seeds: must be a number of them, or FIRST-LAST, not '{text}'")


def _add_options(one: argparse.ArgumentParser) -> None:
    add = one.add_argument
    add("question", nargs="*", metavar="QUESTION", help=f"{QUESTIONS} (default: all)")
    add("--out", type=Path, default=Path("docs/results"), metavar="DIR")
    options.add_jobs(one)
    add("--quick", action="store_true", help="a smoke run; its figures mean nothing")
    about = "trials of each cell, or from which seed to which (40-79)"
    add("--seeds", default="", metavar="N", help=about)
    about = "in place of the question's"
    add("--objects", type=_names, default=(), metavar="A,B", help=about)
    about = "cells, all that begin with a word (moved), methods, guides or motions: no others"
    add("--cells", type=_names, default=(), metavar="A,B", help=about)
    options.add_layouts(one, "a ring of 5 rows")


if __name__ == "__main__":
    sys.exit(main())
