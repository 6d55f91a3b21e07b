"""`taxeld-hil matrix`, `touches` and `calibration`: measurements of many runs."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld.command_line import Commands, add_renamed, command
from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.jobs import Job

OBJECTS = ("box", "mug")  # bundles
SOFT = ("typical", "poor")  # foams


def add(commands: Commands) -> None:
    """Add all three commands."""
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
    _add_runs(matrix, ("scene", *SOFT), seeds=5)

    touches = command(
        commands,
        "touches",
        "Measure how well ten touches of a soft skin find an object.",
        "taxeld-hil touches --object box --seeds 2 --out touches",
        run=_touches,
    )
    _add_objects(touches)
    _add_runs(touches, SOFT, seeds=30)
    about = "instead: draw presses on skins of three pitches, beside the model of their leak"
    touches.add_argument("--picture", type=Path, metavar="FILE", help=about)

    calibration = command(
        commands,
        "calibration",
        "Measure what a calibration finds and how much it helps.",
        "taxeld-hil calibration --seeds 1 --out calibration",
        run=_calibration,
    )
    _add_runs(calibration, SOFT, seeds=5)
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


def _add_runs(one: argparse.ArgumentParser, foams: tuple[str, ...], seeds: int) -> None:
    """The arguments of every measurement; `foams` and `seeds` are its own."""
    one.set_defaults(foams=foams)
    about = f"default: {', '.join(foams)}"
    add_renamed(one, "--skin", one.add_argument("--foam", action="append", help=about))
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
    done = jobs.run(todo, args.memory, workers=args.workers, dask=args.dask, describe=describe)
    runs = [done[job.name] for job in todo]
    measurement.save(args.out / name, runs)
    return runs


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
