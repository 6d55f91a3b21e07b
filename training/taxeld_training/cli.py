"""`taxeld-train`: the offline commands."""

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import command_line
from taxeld.command_line import command
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_training.objects import DEPTH_MAX_M, HEIGHT_M

if TYPE_CHECKING:
    import trimesh

    from taxeld.layout.layout import Layout

DEFAULT_SKIN = SkinConfig().layout
EXPERIMENTS = ("proposals", "frontier", "filter", "stability", "push")


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments."""
    return command_line.main(_parser(), argv, "taxeld-train: ")


def _build(args: argparse.Namespace) -> int:
    from taxeld.layout import read as layouts
    from taxeld_training.build import STAGES, build, summary
    from taxeld_training.jobs import stages
    from taxeld_training.models.variants import trained_with
    from taxeld_training.objects import meshes
    from taxeld_training.samplers.candidates import VARIANTS, Candidates

    given = Candidates(
        variants=tuple(trained_with(v, args.effort, args.contacts, args.seed) for v in VARIANTS),
        bank=args.bank or Candidates.bank,
        readings=args.readings or Candidates.readings,
        seed=args.seed,
    )
    skin = layouts.load(args.skin)
    _doubt(args, meshes.load(meshes.find(args.object)[0]), skin)
    began_s = time.monotonic()
    with stages.shown(STAGES, sys.stderr) as progress:
        out = build(args.object, skin, args.height_m, given, args.out, progress)
    info = json.loads((out / "bundle.json").read_text(encoding="utf-8"))
    for repair in info["repairs"]:
        print(f"taxeld-train: {args.object}: {repair}", file=sys.stderr)
    is_default = args.skin == DEFAULT_SKIN
    print("\n".join(summary(out, info, "" if is_default else args.skin)))
    print(f"took       {time.monotonic() - began_s:.0f} s")
    return 0


def _seal(args: argparse.Namespace) -> int:
    from taxeld_training import bundles

    bundles.seal(args.bundle)
    print(f"{args.bundle}: sealed")
    return 0


def _scene(args: argparse.Namespace) -> int:
    from taxeld.layout import read as layouts
    from taxeld.model.scene import CONTINUOUS
    from taxeld_training.objects import meshes, scenes

    skin = layouts.load(args.skin)
    mesh = meshes.load(meshes.find(args.object)[0])
    scene = scenes.build(mesh, skin, args.height_m)
    error = scenes.grid_error(scene, mesh, skin, args.height_m, DEPTH_MAX_M)
    heights = (args.height_m + scene.heights) * 1e3
    met = sum(bool((piece < 0.0).any()) for piece in scene.slices)
    turn = {CONTINUOUS: "continuous", 1: "none"}.get(scene.symmetry, f"{scene.symmetry}-fold")
    repairs = scenes.repairs(mesh, skin, args.height_m)
    size = scene.slices.nbytes + scene.silhouette.nbytes
    print(f"extents     {' × '.join(f'{length * 1e3:.0f}' for length in mesh.extents)} mm")
    print(
        f"slices      {len(heights)}, {heights[0]:.0f} to {heights[-1]:.0f} mm above the lowest "
        f"point, {met} of which meet the object"
    )
    print(f"symmetry    {turn}")
    print(f"repairs     {'; '.join(repairs) or 'none'}")
    print(f"grid error  rms {error.rms:.3f}, 99 % under {error.p99:.3f}, max {error.max:.3f} mm")
    print(f"grid        {size / 1e3:.0f} kB")
    _doubt(args, mesh, skin)
    if args.png:
        from taxeld_training.objects.scene_picture import draw

        title = f"{args.object} on {skin.name}"
        try:
            draw(mesh, scene, skin, args.height_m, title, args.png)
        except OSError as error:
            raise SetupError(f"--png: cannot write {args.png} ({error.strerror})") from None
    return 0


def _doubt(args: argparse.Namespace, mesh: "trimesh.Trimesh", skin: "Layout") -> None:
    """Warn of probable faults in how the mesh lies and is cut."""
    from taxeld_training.objects.doubts import doubts

    for line in doubts(mesh, skin, args.height_m):
        print(f"taxeld-train: {args.object}: warning: {line}", file=sys.stderr)


def _evaluate(args: argparse.Namespace) -> int:
    from taxeld_training.filters import experiment, push, sampled
    from taxeld_training.jobs.options import Options
    from taxeld_training.samplers import evaluate

    if args.cells and args.experiment not in ("proposals", "filter", "stability"):
        raise SetupError("--cells: only proposals, filter and stability have cells to choose from")
    given = {k: v for k, v in vars(args).items() if k in Options.__dataclass_fields__}
    options = Options(**given, until=time.monotonic() + 60.0 * args.minutes)
    experiments = {
        "proposals": sampled.run if args.cells else evaluate.proposals,
        "frontier": evaluate.frontier,
        "filter": experiment.filter_rows,
        "stability": experiment.stability_rows,
        "push": push.run,
    }
    for path in experiments[args.experiment](options):
        print(path)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-train",
        "Make what the daemon needs of an object, and run the experiments.",
        "taxeld-train scene bracket.stl --height-m 0.05",
        "taxeld-train build bracket.stl --height-m 0.05 --out bracket",
    )
    commands = command_line.commands_of(parser)
    one = command(
        commands,
        "scene",
        "Show what the skin meets of an object, before a bundle is built.",
        "taxeld-train scene 025_mug",
        "taxeld-train scene bracket.stl --height-m 0.05 --png bracket.png",
        run=_scene,
    )
    _add_object(one)
    one.add_argument(
        "--png", type=Path, metavar="OUT", help="draw the object, the skin's heights and the slices"
    )
    one = command(
        commands,
        "build",
        "Build the bundle of an object and a skin, which the daemon runs with.",
        "taxeld-train build 025_mug --out mug",
        "taxeld-train build bracket.stl --skin skin.json --height-m 0.05 --out bracket",
        run=_build,
    )
    _add_object(one)
    one.add_argument(
        "--out", type=Path, required=True, metavar="BUNDLE", help="directory of the bundle"
    )
    one.add_argument(
        "--effort",
        type=float,
        default=1.0,
        metavar="SHARE",
        help="share of each model's full training (default %(default)s)",
    )
    one.add_argument(
        "--contacts",
        type=int,
        default=300_000,
        help="simulated contacts to train on (default %(default)s)",
    )
    one.add_argument("--bank", type=int, help="contacts that exact posteriors begin with")
    one.add_argument("--readings", type=int, help="readings that samplers are measured on")
    one.add_argument("--seed", type=int, default=0)
    one = command(
        commands,
        "seal",
        "Write the digests of a bundle's files into it, as they are now.",
        "taxeld-train seal bracket",
        run=_seal,
    )
    one.add_argument("bundle", type=Path, metavar="BUNDLE")
    _add_options(
        command(
            commands,
            "evaluate",
            "Run an experiment; it writes JSON and pictures.",
            "taxeld-train evaluate proposals --quick --out results",
            run=_evaluate,
        )
    )
    return parser


def _add_object(one: argparse.ArgumentParser) -> None:
    """The arguments of `scene` and `build`."""
    one.add_argument(
        "object",
        metavar="OBJECT",
        help="a YCB id (025_mug), or a mesh file in metres whose z axis points up",
    )
    one.add_argument(
        "--skin",
        default=DEFAULT_SKIN,
        metavar="LAYOUT",
        help="as skin.layout in the configuration (default %(default)s)",
    )
    one.add_argument(
        "--height-m",
        type=float,
        default=HEIGHT_M,
        metavar="H",
        help="the sensor frame's origin above the object's lowest point (default %(default)s)",
    )


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, text.split(",")))


def _counts(text: str) -> tuple[int, ...]:
    return tuple(map(int, _names(text)))


def _add_options(one: argparse.ArgumentParser) -> None:
    """The arguments of `evaluate`."""
    add = one.add_argument
    add("experiment", choices=EXPERIMENTS)
    add("--out", type=Path, default=Path("docs/results"), metavar="DIR")
    add(
        "--memory",
        type=Path,
        default=Path(".experiments"),
        metavar="DIR",
        help="finished jobs; what was interrupted goes on from them (default %(default)s)",
    )
    add("--quick", action="store_true", help="a smoke run; its figures mean nothing")
    add(
        "--objects",
        type=_names,
        default=(),
        metavar="A,B",
        help="default: the paper's ten; of stability, push and cells of proposals, box and mug",
    )
    add("--columns", type=_counts, default=(), metavar="N,M", help="of the 5-row skins")
    add("--skin", default="", metavar="LAYOUT", help="this layout in place of them")
    add("--workers", type=int, default=2, help="processes of one thread each")
    add(
        "--groups",
        type=_names,
        default=(),
        metavar="A,B",
        help="of samplers (analytic, paper, …), or of filters (table, shipped, …)",
    )
    add(
        "--cells",
        type=_names,
        default=(),
        metavar="A,B",
        help="conditions: factors (noise, skin, 'wrong object', …) or a level of one (moved=5)",
    )
    add("--effort", type=float, default=1.0, metavar="SHARE", help="of a model's own training")
    add("--seeds", type=int, default=0, metavar="N", help="trials a cell of a filter experiment")
    add("--minutes", type=float, default=math.inf, help="begin nothing later; write what is done")
    add("--dask", default="", metavar="ADDRESS", help="a running Dask scheduler")
    add("--seed", type=int, default=0)


if __name__ == "__main__":
    sys.exit(main())
