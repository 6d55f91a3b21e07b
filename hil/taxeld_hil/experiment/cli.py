"""`taxeld-hil expect`, `matrix`, `touches` and `calibration`: measurements of many runs."""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld.command_line import Commands, add_renamed, command
from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.jobs import Job
from taxeld_hil.scenario.mesh_config import FOAMS

OBJECTS = ("box", "mug")  # bundles
SOFT = ("typical", "poor")  # foams


def add(commands: Commands) -> None:
    """Add all four commands."""
    expect = command(
        commands,
        "expect",
        "Say how well an object will be found with a skin, before it is bought.",
        "taxeld-hil expect --object box --layout skin.json",
        "taxeld-hil expect --object bracket.stl --layout skin.json --foam poor --robot-mm 2",
        run=_expect,
    )
    _add_expect(expect)
    _add_runs(expect, seeds=60)

    matrix = command(
        commands,
        "matrix",
        "Run scenarios on several objects and skins, seed by seed.",
        "taxeld-hil matrix demo --seeds 2 --out matrix",
        run=_matrix,
    )
    matrix.add_argument("scenario", nargs="*", metavar="SCENARIO", help="default: all shipped")
    matrix.add_argument(
        "--real",
        action="store_true",
        help="run the scenarios whose faults need real time in real time",
    )
    _add_objects(matrix)
    _add_foams(matrix, ("scene", *SOFT))
    _add_runs(matrix, seeds=5)

    touches = command(
        commands,
        "touches",
        "Measure how well ten touches of a soft skin find an object.",
        "taxeld-hil touches --object box --seeds 2 --out touches",
        run=_touches,
    )
    _add_objects(touches)
    _add_foams(touches, SOFT)
    _add_runs(touches, seeds=30)
    about = "instead: draw presses on skins of three pitches, beside the model of their leak"
    touches.add_argument("--picture", type=Path, metavar="FILE", help=about)

    calibration = command(
        commands,
        "calibration",
        "Measure what a calibration finds and how much it helps.",
        "taxeld-hil calibration --seeds 1 --out calibration",
        run=_calibration,
    )
    _add_foams(calibration, SOFT)
    _add_runs(calibration, seeds=5)
    calibration.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="instead: draw the calibration of one skin there",
    )


def _add_objects(one: argparse.ArgumentParser) -> None:
    about = f"default: {', '.join(OBJECTS)}"
    one.add_argument("--object", action="append", metavar="BUNDLE", help=about)
    jobs.add_layouts(one, "what each object's bundle was built for")


def _add_expect(one: argparse.ArgumentParser) -> None:
    about = "a bundle (box, drill, mug, a path), a YCB id or a mesh file"
    one.add_argument("--object", required=True, help=about)
    about = "as skin.layout; default: what a bundle was built for"
    one.add_argument("--layout", default="", help=about)
    about = f"default: typical; {', '.join(FOAMS)}"
    one.add_argument("--foam", default="typical", help=about)
    about = "the robot's error in x and in y, sd, drawn for each touch (default %(default)s)"
    one.add_argument("--robot-mm", type=float, default=1.0, metavar="SD", help=about)
    about = "the sensor frame's origin above the object's lowest point (default: as it fits)"
    one.add_argument("--height-m", type=float, metavar="H", help=about)
    about = "of the foam, at full scale (default: 5, or the bundle's)"
    one.add_argument("--depth-mm", type=float, metavar="D", help=about)
    one.add_argument("--touches", type=int, default=8, metavar="N", help="default %(default)s")
    about = "begin no run after so long; the same command goes on (default %(default)s)"
    one.add_argument("--minutes", type=float, default=4.0, help=about)
    about = "try whether it works: 2 seeds of 3 touches"
    one.add_argument("--quick", action="store_true", help=about)


def _add_foams(one: argparse.ArgumentParser, foams: tuple[str, ...]) -> None:
    """`--foam`, several times; `foams` are those without it."""
    one.set_defaults(foams=foams)
    about = f"default: {', '.join(foams)}"
    add_renamed(one, "--skin", one.add_argument("--foam", action="append", help=about))


def _add_runs(one: argparse.ArgumentParser, seeds: int) -> None:
    """The arguments of every measurement; `seeds` is its own."""
    one.add_argument(
        "--seeds",
        type=int,
        default=seeds,
        metavar="N",
        help="runs of each kind (default %(default)s)",
    )
    one.add_argument("--workers", type=int, default=2, help="runs at a time, one thread each")
    one.add_argument("--dask", default="", metavar="ADDRESS", help="a running Dask scheduler")
    one.add_argument(
        "--memory",
        type=Path,
        default=Path(".experiments"),
        metavar="DIR",
        help="finished runs; what was interrupted goes on from them (default %(default)s)",
    )
    one.add_argument("--out", type=Path, metavar="DIR", help="for the JSON")


def _expect(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import expect, expect_report
    from taxeld_hil.experiment.expect_subjects import Asked, subjects

    until = time.monotonic() + 60.0 * args.minutes
    seeds, touches = (2, 3) if args.quick else (args.seeds, args.touches)
    for option, value in (("--seeds", seeds), ("--touches", touches)):
        if value < 1:
            raise SetupError(f"{option} must be at least 1")
    depth_m = None if args.depth_mm is None else 1e-3 * args.depth_mm
    asked = Asked(args.object, args.layout, args.foam, 1e-3 * args.robot_mm, args.height_m, depth_m)
    tried = subjects(asked, args.memory / "expect")
    args.out = args.out or Path("expect")
    todo = expect.jobs(tried, seeds, touches)
    runs = _done(todo, args, expect.described, until)
    for line in expect_report.written(asked, tried[expect.AS_IS], runs, args.out):
        print(line)
    if len(runs) < len(todo):
        print(f"{len(runs)} of {len(todo)} runs in {args.minutes:g} minutes; again for more")
    return 0


def _matrix(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import matrix
    from taxeld_hil.scenario import scenario as scenarios

    names = args.scenario or list(scenarios.shipped())
    objects, foams = args.object or OBJECTS, args.foam or args.foams
    layouts = jobs.layouts(args.layout)
    todo = matrix.jobs(names, objects, foams, args.seeds, real=args.real, layouts=layouts)
    runs = _run(todo, args, matrix.described, "scenarios.json")
    for line in matrix.lines(runs):
        print(line)
    return 0 if all(run["passed"] for run in runs) else 1


def _touches(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import measurement, touches

    if args.picture:
        from taxeld_hil.experiment import pitches

        foam = (args.foam or args.foams)[0]
        measurement.require((), [foam], 1, soft=True)
        pitches.draw(foam, args.picture)
        print(args.picture)
        return 0
    objects, layouts = args.object or OBJECTS, jobs.layouts(args.layout)
    todo = touches.jobs(objects, args.foam or args.foams, args.seeds, layouts)
    runs = _run(todo, args, touches.described, "touches.json")
    for line in touches.lines(runs):
        print(line)
    return 0


def _run(
    todo: list[Job], args: argparse.Namespace, describe: Callable[[Any], str], name: str
) -> list[dict[str, Any]]:
    """The jobs' results, which are also saved under this name in the directory `--out`."""
    from taxeld_hil.experiment import measurement

    if args.out is None:
        raise SetupError("--out: is required")
    runs = _done(todo, args, describe)
    measurement.save(args.out / name, runs)
    return runs


def _done(
    todo: list[Job],
    args: argparse.Namespace,
    describe: Callable[[Any], str],
    until: float = math.inf,
) -> list[dict[str, Any]]:
    """The results of the jobs that were begun until then (monotonic clock [s])."""
    how = {"workers": args.workers, "dask": args.dask, "until": until, "describe": describe}
    done = jobs.run(todo, args.memory, **how)
    return [done[job.name] for job in todo if done[job.name] is not None]


def _calibration(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import calibration

    if args.picture:
        from taxeld_hil.calibration.picture import draw

        draw(calibration.pictured((args.foam or args.foams)[0]), args.picture)
        print(args.picture)
        return 0
    todo = calibration.jobs(args.foam or args.foams, args.seeds)
    runs = _run(todo, args, calibration.described, "calibration.json")
    for line in calibration.lines(runs):
        print(line)
    return 0
