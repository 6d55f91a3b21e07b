"""`taxeld-train`: the offline commands."""

import argparse
import re
import sys
from pathlib import Path

from taxeld import command_line
from taxeld.command_line import Argument, Arguments, Run, flag, given
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_sim import jobs
from taxeld_sim.objects import HEIGHT_M

QUESTIONS = "works, whole, map, which, advice, push, published, samplers, real"
DEPTHS_MM = 0.1, 50.0  # limits, as of skin.full_scale_depth_m
OBJECT = "a YCB id (025_mug), or a mesh file in metres whose z axis points up"


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments."""
    return command_line.main(_parser(), argv, "taxeld-train: ")


def _build(args: argparse.Namespace) -> int:
    """Build what the daemon needs of an object and a skin, or a bundle of each of several.

    taxeld-train build 025_mug --out mug
    taxeld-train build bracket.stl --layout skin.json --height-m 0.05 --table --out bracket
    taxeld-train build 003_cracker_box 025_mug 035_power_drill --table --out bank
    """
    from taxeld_training import candidates, closing
    from taxeld_training.build import Build

    skins, heights_m = args.layout or [SkinConfig().layout], args.height_m or [HEIGHT_M]
    if len(heights_m) not in (1, len(skins)):
        raise SetupError(
            f"--height-m: {len(heights_m)} heights for {len(skins)} layouts; give one for all, or "
            "one for each --layout"
        )
    heights_m = (heights_m * len(skins))[: len(skins)]
    samplers = [] if args.table else candidates.of(args.effort, ddpm=args.ddpm)
    trials = closing.ENOUGH if args.table or args.effort >= 1.0 else closing.FEW
    asked = args.object, skins, heights_m, _depth_m(args), args.out, samplers, args.foam, trials
    for line in Build(*asked).run():
        print(line)
    return 0


def _seal(args: argparse.Namespace) -> int:
    """Write the digests of a bundle's files into it, as they are now.

    taxeld-train seal bracket
    """
    from taxeld_sim.objects import bundles

    bundles.seal(args.bundle)
    print(f"{args.bundle}: sealed")
    return 0


def _scene(args: argparse.Namespace) -> int:
    """Show what the skin meets of an object, before a bundle is built.

    taxeld-train scene 025_mug
    taxeld-train scene bracket.stl --height-m 0.05 --png bracket.png
    """
    from taxeld_training import build
    from taxeld_training.objects import report

    skin, height_m = args.layout or SkinConfig().layout, args.height_m or HEIGHT_M
    for line in report.lines(args.object, skin, height_m, args.png):
        print(line)
    print(f"next        {build.command(args.object, skin, height_m, _depth_m(args))}")
    build.warn_of_doubts(args.object, skin, height_m)
    return 0


def _depth_m(args: argparse.Namespace) -> float:
    """The depth of a press at full scale. Raises SetupError."""
    least, most = DEPTHS_MM
    if not least <= args.depth_mm <= most:
        raise SetupError(f"--depth-mm: must be {least:g}..{most:g}, not {args.depth_mm:g}")
    return float(args.depth_mm / 1e3)


def _evaluate(args: argparse.Namespace) -> int:
    """Answer questions by trials, simulated ones and recorded ones: tables, JSON and pictures.

    taxeld-train evaluate works --quick --out results
    taxeld-train evaluate map --cells moved,robot --objects 025_mug --out results
    taxeld-train evaluate real --data recordings --out results
    """
    from taxeld_sim.answers.questions import Selection, names
    from taxeld_training.evaluation import run

    layouts = tuple(jobs.layouts(args.layout))
    seeds = _seeds(args.seeds)
    asked = Selection(args.quick, seeds, args.objects, args.cells, layouts, args.data)
    wanted = args.question or names(recorded=args.data is not None)
    workers = run.Workers(args.workers, args.memory)
    for line in run.answer(wanted, asked, workers, args.out):
        print(line, flush=True)
    return 0


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


DEPTH_MM = 1e3 * SkinConfig().full_scale_depth_m
EACH = "; again for each further link"


def _of_skin(more: str = "", action: str = "store") -> tuple[Argument, ...]:
    """Options that say where the skin meets an object; `more` and `action`: of those that are given
    for each link."""
    about = f"as skin.layout in the configuration{more} (default {SkinConfig().layout})"
    height = f"the sensor frame's origin above the object's lowest point{more} (default {HEIGHT_M})"
    return (
        given("--layout", "LAYOUT", about, action=action),
        given("--height-m", "H", height, float, action=action),
        given(
            "--depth-mm", "D", f"of a press at full scale ({DEPTH_MM:g})", float, default=DEPTH_MM
        ),
    )


COMMANDS: dict[Run, Arguments] = {
    _scene: (
        given("object", "OBJECT", OBJECT),
        *_of_skin(),
        given("--png", "OUT", "draw the object and the skin's heights", Path),
    ),
    _build: (
        given("object", "OBJECT", OBJECT, nargs="+"),
        *_of_skin(EACH, "append"),
        given("--out", "BUNDLE", "a directory; of several objects, of theirs", Path, required=True),
        flag("--table", "train no sampler: simulated contacts, looked up, propose poses"),
        given("--effort", "SHARE", "of the sampler's full training (1)", float, default=1.0),
        flag("--ddpm", "also the diffusion, a baseline; takes twice as long"),
        given("--foam", "FOAM", "of the trials at the end (typical)", default="typical"),
    ),
    _seal: (given("bundle", "BUNDLE", "a directory", Path),),
    _evaluate: (
        given("question", "QUESTION", f"{QUESTIONS} (default: all)", nargs="*"),
        given("--out", "DIR", "for the tables", Path, default=Path("docs/results")),
        jobs.WORKERS,
        given("--memory", "DIR", "finished jobs", Path, default=jobs.MEMORY),
        flag("--quick", "a smoke run; its figures mean nothing"),
        given("--seeds", "N", "trials of each cell, or FIRST-LAST (40-79)", default=""),
        given("--objects", "A,B", "in place of the question's", _names, default=()),
        given("--cells", "A,B", "that begin so (moved), methods, guides", _names, default=()),
        jobs.layout_option("a ring of 5 rows"),
        given("--data", "DIR", "of 'real': what examples/nao_recordings.py makes", Path),
    ),
}


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-train",
        "Make what the daemon needs of an object, and answer questions by trials.",
        "taxeld-train scene bracket.stl --height-m 0.05",
        "taxeld-train build bracket.stl --height-m 0.05 --out bracket",
    )
    command_line.add_commands(parser, COMMANDS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
