"""`taxeld-train`: the offline commands."""

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import command_line
from taxeld.command_line import add_renamed, documented
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.objects import HEIGHT_M
from taxeld_training.objects import DEPTH_MAX_M

if TYPE_CHECKING:
    import trimesh

    from taxeld.layout.layout import Layout
    from taxeld_training.filters.touches import EndTrials
    from taxeld_training.samplers.candidates import Candidates

DEPTHS_MM = 0.1, 50.0  # limits, as of skin.full_scale_depth_m
UPRIGHT = "the link's axis must be vertical (within 0.1 rad), and the object stand as its mesh does"
LONGER = 3.0  # times the effort, as a cure for poor samplers
QUICK = {"effort": 0.02, "contacts": 30_000, "bank": 50_000, "readings": 10, "trials": 8}
EXPERIMENTS = (
    "proposals",
    "filter",
    "whole",
    "works",
    "stability",
    "reliability",
    "recognise",
    "links",
    "prior",
    "advice",
    "ablation",
    "push",
    "integrity",
)
UNCELLED = ("push", "recognise", "links", "prior")  # of no chosen cells
SINGLE = ("proposals", "recognise")  # experiments of one layout


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments."""
    command_line.one_thread()
    return command_line.main(_parser(), argv, "taxeld-train: ")


def _build(args: argparse.Namespace) -> int:
    """Build what the daemon needs of an object and a skin, or a bundle of each of several.

    taxeld-train build 025_mug --out mug
    taxeld-train build bracket.stl --layout skin.json --height-m 0.05 --quick --out bracket
    taxeld-train build 003_cracker_box 025_mug 035_power_drill --out bank
    """
    from taxeld.layout import read as layouts
    from taxeld_hil.objects import meshes
    from taxeld_training.filters import touches
    from taxeld_training.models.variants import diffusion, trained_with
    from taxeld_training.samplers.candidates import VARIANTS, Candidates

    full = {"effort": 1.0, "contacts": 300_000, "trials": touches.EndTrials.trials}
    full |= {"bank": Candidates.bank, "readings": Candidates.readings}
    named = {name: getattr(args, name) for name in full if getattr(args, name) is not None}
    size = full | (QUICK if args.quick else {}) | named
    wanted = (*VARIANTS, diffusion()) if args.ddpm else VARIANTS
    given = Candidates(
        variants=tuple(
            trained_with(v, size["effort"], int(size["contacts"]), args.seed) for v in wanted
        ),
        bank=int(size["bank"]),
        readings=int(size["readings"]),
        seed=args.seed,
    )
    asked = touches.EndTrials(args.foam, int(size["trials"]), args.seed)
    depth_m, skin = _depth_m(args), layouts.load(args.layout)
    if len(args.object) > 1:
        unused = [f"--{name}" for name in ("ddpm", *named) if getattr(args, name)]
        if not args.samplers and (unused := [name for name in unused if name != "--trials"]):
            raise SetupError(f"{unused[0]}: trains nothing of several objects; add --samplers")
        return _build_several(args, skin, depth_m, given if args.samplers else None, asked)
    _doubt(args, args.object[0], meshes.load(meshes.find(args.object[0])[0]), skin)
    for line in _build_one(args, args.object[0], skin, depth_m, given, asked, args.out):
        print(line)
    return 0


def _build_one(
    args: argparse.Namespace,
    name: str,
    skin: "Layout",
    depth_m: float,
    given: "Candidates",
    asked: "EndTrials",
    out: Path,
) -> Iterator[str]:
    """Build a bundle with samplers; → lines on it, and how long it took."""
    from taxeld_training.build import STAGES, build, summary
    from taxeld_training.jobs import stages
    from taxeld_training.samplers.candidates import CONTACTS, TRAINING

    began_s, ended_s = time.monotonic(), dict[str, float]()
    with stages.shown(STAGES, sys.stderr) as tell:

        def progress(stage: str, share: float) -> None:
            ended_s[stage] = time.monotonic()
            tell(stage, share)

        further = _further(args)
        build(name, skin, args.height_m, depth_m, given, asked, out, progress, further)
    info = json.loads((out / "bundle.json").read_text(encoding="utf-8"))
    for repair in info["repairs"]:
        print(f"taxeld-train: {name}: {repair}", file=sys.stderr)
    took_s = time.monotonic() - began_s
    longer = took_s + (LONGER - 1.0) * (ended_s[TRAINING] - ended_s[CONTACTS])
    effort = 1.0 if args.effort is None else args.effort
    more = f"--effort {LONGER * effort:g} would take about {longer / 60.0:.0f} min here"
    if args.quick:
        more = "--quick asked for no more; build without it for use"
    yield from summary(out, info, args.layout, more)
    yield f"took       {took_s:.0f} s"


def _build_several(
    args: argparse.Namespace,
    skin: "Layout",
    depth_m: float,
    given: "Candidates | None",
    asked: "EndTrials",
) -> int:
    """Build bundles, and try which of their objects touch can tell apart."""
    from taxeld_hil.objects import meshes
    from taxeld_training import several
    from taxeld_training.build import SCENE, build
    from taxeld_training.filters import alike
    from taxeld_training.jobs import stages

    began_s = time.monotonic()
    places = several.places(args.object, args.out)
    several.check(args.object, skin, args.height_m, depth_m)
    for name in places:
        _doubt(args, name, meshes.load(meshes.find(name)[0]), skin)
    if given is not None:
        for number, (name, out) in enumerate(places.items(), 1):
            print(f"{number}/{len(places)} {name}", file=sys.stderr)
            for line in _build_one(args, name, skin, depth_m, given, asked, out):
                print(line)
    made = (SCENE, alike.STAGE) if given is None else (alike.STAGE,)
    with stages.shown(made, sys.stderr) as tell:
        for number, (name, out) in enumerate(places.items(), 1):
            if given is None:
                quiet, further = (lambda *_: None), _further(args)
                build(name, skin, args.height_m, depth_m, None, asked, out, quiet, further)
                tell(SCENE, number / len(places))
        told = alike.pairs(list(places.values()), skin, asked, tell)
    for out in places.values() if given is None else ():
        print(several.size_line(out))
    print("\n".join(several.tell_pairs(told, args.out)))
    print(f"took       {time.monotonic() - began_s:.0f} s")
    print(several.key_line(list(places.values())))
    return 0


def _further(args: argparse.Namespace) -> "list[tuple[Layout, float]]":
    """Layouts and heights of further links: each as often as the other, or one height for all.
    Raises SetupError."""
    from taxeld.layout import read as layouts

    named, heights = getattr(args, "layout_more", []), getattr(args, "height_m_more", [])
    if heights and len(heights) != len(named):
        raise SetupError(
            f"--height-m: {len(heights) + 1} heights for {len(named) + 1} layouts; give one for "
            "all, or one for each --layout"
        )
    heights = heights or [args.height_m] * len(named)
    return [(layouts.load(one), height) for one, height in zip(named, heights, strict=True)]


def _depth_m(args: argparse.Namespace) -> float:
    """The depth of a press at full scale. Raises SetupError."""
    least, most = DEPTHS_MM
    if not least <= args.depth_mm <= most:
        raise SetupError(f"--depth-mm: must be {least:g}..{most:g}, not {args.depth_mm:g}")
    return float(args.depth_mm / 1e3)


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
    from taxeld.layout import read as layouts
    from taxeld.model.scene import CONTINUOUS
    from taxeld_hil.objects import meshes, scenes
    from taxeld_training.build import command

    depth_m, skin = _depth_m(args), layouts.load(args.layout)
    mesh = meshes.load(meshes.find(args.object)[0])
    scene = scenes.build(mesh, skin, args.height_m)
    error = scenes.grid_error(scene, mesh, skin, args.height_m, depth_m)
    heights = (args.height_m + scene.heights) * 1e3
    met = sum(bool((piece < 0.0).any()) for piece in scene.slices)
    turn = {CONTINUOUS: "continuous", 1: "none"}.get(scene.symmetry, f"{scene.symmetry}-fold")
    repairs = scenes.repairs(mesh, skin, args.height_m)
    size = scene.slices.nbytes + scene.silhouette.nbytes
    print(f"upright     {UPRIGHT}")
    print(f"extents     {' × '.join(f'{length * 1e3:.0f}' for length in mesh.extents)} mm")
    print(
        f"slices      {len(heights)}, {heights[0]:.0f} to {heights[-1]:.0f} mm above the lowest "
        f"point, {met} of which meet the object"
    )
    print(f"symmetry    {turn}")
    print(f"repairs     {'; '.join(repairs) or 'none'}")
    print(f"grid error  rms {error.rms:.3f}, 99 % under {error.p99:.3f}, max {error.max:.3f} mm")
    print(f"grid        {size / 1e3:.0f} kB")
    print(f"next        {command(args.object, args.layout, args.height_m, depth_m)}")
    _doubt(args, args.object, mesh, skin)
    if args.png:
        from taxeld_training.objects.scene_picture import draw

        title = f"{args.object} on {skin.name}\n{UPRIGHT}"
        try:
            draw(mesh, scene, skin, args.height_m, title, args.png)
        except OSError as error:
            raise SetupError(f"--png: cannot write {args.png} ({error.strerror})") from None
    return 0


def _doubt(args: argparse.Namespace, name: str, mesh: "trimesh.Trimesh", skin: "Layout") -> None:
    """Warn of probable faults in how the mesh lies and is cut."""
    from taxeld_training.objects.doubts import doubts

    for line in doubts(mesh, skin, args.height_m):
        print(f"taxeld-train: {name}: warning: {line}", file=sys.stderr)


def _evaluate(args: argparse.Namespace) -> int:
    """Run an experiment; it writes JSON and pictures.

    taxeld-train evaluate proposals --quick --out results
    """
    from taxeld_training.filters import (
        ablation,
        advised,
        experiment,
        integrity,
        linked,
        priors,
        push,
        recognise,
        reliability,
        sampled,
        whole,
        works,
    )
    from taxeld_training.jobs.options import Options
    from taxeld_training.samplers import evaluate

    if args.cells and args.experiment in UNCELLED:
        raise SetupError(f"--cells: {args.experiment} has no cells to choose from")
    given = {k: v for k, v in vars(args).items() if k in Options.__dataclass_fields__}
    given["layouts"] = _layouts(args)
    options = Options(**given, until=time.monotonic() + 60.0 * args.minutes)
    experiments = {
        "proposals": sampled.run if args.cells else evaluate.proposals,
        "filter": experiment.filter_rows,
        "whole": whole.whole_rows,
        "works": works.work_rows,
        "stability": experiment.stability_rows,
        "reliability": reliability.reliability_rows,
        "integrity": integrity.integrity_rows,
        "recognise": recognise.recognise_rows,
        "links": linked.link_rows,
        "prior": priors.prior_rows,
        "advice": advised.advice_rows,
        "ablation": ablation.ablation_rows,
        "push": push.run,
    }
    for path in experiments[args.experiment](options):
        print(path)
    return 0


def _layouts(args: argparse.Namespace) -> tuple[str, ...]:
    """Raises SetupError where a layout cannot be read, or the experiment has no room for it."""
    from taxeld.layout import read as layouts

    found = tuple(jobs.layouts(args.layout))
    if args.experiment in SINGLE and len(found) > 1:
        raise SetupError(f"--layout: {args.experiment} has room for one; run it for each")
    of_shipped = args.experiment == "push" or (args.experiment == "proposals" and args.cells)
    if of_shipped and found != ("",):
        raise SetupError(f"--layout: {args.experiment} is of the shipped bundles' own layout here")
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
    """The parser with the arguments of `scene` and `build`."""
    action = "store" if nargs is None else _OneALink
    add = one.add_argument
    about = "a YCB id (025_mug), or a mesh file in metres whose z axis points up"
    add("object", metavar="OBJECT", nargs=nargs, help=about)
    about = "as skin.layout in the configuration (default %(default)s)"
    about += "" if nargs is None else "; again for each further link"
    layout = add("--layout", action=action, default=SkinConfig().layout, help=about)
    add_renamed(one, "--skin", layout)
    about = "the sensor frame's origin above the object's lowest point (default %(default)s)"
    add("--height-m", action=action, type=float, default=HEIGHT_M, metavar="H", help=about)
    about = "depth of a press at full scale (default %(default)g)"
    add("--depth-mm", type=float, default=1e3 * DEPTH_MAX_M, metavar="D", help=about)
    return one


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, text.split(",")))


def _counts(text: str) -> tuple[int, ...]:
    return tuple(map(int, _names(text)))


def _add_options(one: argparse.ArgumentParser) -> None:
    """The arguments of `evaluate`."""
    add = one.add_argument
    add("experiment", choices=EXPERIMENTS)
    add("--out", type=Path, default=Path("docs/results"), metavar="DIR")
    about = "finished jobs; what was interrupted goes on from them (default %(default)s)"
    add("--memory", type=Path, default=Path(".experiments"), metavar="DIR", help=about)
    add("--quick", action="store_true", help="a smoke run; its figures mean nothing")
    about = "default: box and mug; of filter, whole, recognise, proposals without --cells the ten"
    add("--objects", type=_names, default=(), metavar="A,B", help=about)
    add("--columns", type=_counts, default=(), metavar="N,M", help="of the 5-row skins")
    add_renamed(one, "--skin", jobs.add_layouts(one, "those skins"))
    add("--workers", type=int, default=2, help="processes of one thread each")
    about = (
        "samplers (analytic, …), filters (table, shipped, …), or of ablation constants (MOVE, …)"
    )
    add("--groups", type=_names, default=(), metavar="A,B", help=about)
    about = "conditions: factors (noise, skin, 'wrong object', …) or a level of one (moved=5)"
    add("--cells", type=_names, default=(), metavar="A,B", help=about)
    add("--effort", type=float, default=1.0, metavar="SHARE", help="of a model's own training")
    add("--seeds", type=int, default=0, metavar="N", help="trials a cell of a filter experiment")
    add("--minutes", type=float, default=math.inf, help="begin nothing later; write what is done")
    add("--dask", default="", metavar="ADDRESS", help="a running Dask scheduler")
    add("--seed", type=int, default=0)


if __name__ == "__main__":
    sys.exit(main())
