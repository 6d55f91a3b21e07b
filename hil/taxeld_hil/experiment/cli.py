"""`taxeld-hil matrix`, `touches` and `calibration`: measurements of many runs."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taxeld.command_line import Commands, command
from taxeld.errors import SetupError

if TYPE_CHECKING:
    from taxeld_hil.jobs import Job

OBJECTS = ("box", "mug")  # bundles


def add(commands: Commands) -> None:
    """All three commands."""
    _add_matrix(commands)
    _add_touches(commands)
    _add_calibration(commands)


def _add_matrix(commands: Commands) -> None:
    matrix = command(
        commands, "matrix", "Run scenarios on several objects and skins, seed by seed.",
        "taxeld-hil matrix demo --seeds 2 --out matrix", run=_matrix,
    )  # fmt: skip
    matrix.add_argument("scenario", nargs="*", metavar="SCENARIO", help="default: all shipped")
    matrix.add_argument(
        "--real", action="store_true",
        help="run the scenarios whose faults need real time in real time",
    )  # fmt: skip
    _add_runs(matrix, ("scene", "typical", "poor"), seeds=5)


def _add_touches(commands: Commands) -> None:
    touches = command(
        commands, "touches", "Measure how well ten touches of a soft skin find an object.",
        "taxeld-hil touches --object box --seeds 2 --out touches", run=_touches,
    )  # fmt: skip
    _add_runs(touches, ("typical", "poor"), seeds=30)


def _add_runs(one: argparse.ArgumentParser, skins: tuple[str, ...], seeds: int) -> None:
    """The arguments of a measurement on objects and skins; `skins` are its own."""
    one.set_defaults(skins=skins)
    one.add_argument(
        "--object", action="append", metavar="BUNDLE", help=f"default: {', '.join(OBJECTS)}"
    )
    one.add_argument("--skin", action="append", metavar="SKIN", help=f"default: {', '.join(skins)}")
    one.add_argument(
        "--seeds", type=int, default=seeds, metavar="N",
        help="runs of each object and skin (default %(default)s)",
    )  # fmt: skip
    _add_workers(one)
    one.add_argument("--dask", default="", metavar="ADDRESS", help="a running Dask scheduler")
    one.add_argument("--out", type=Path, required=True, metavar="DIR", help="for the JSON")


def _add_workers(one: argparse.ArgumentParser) -> None:
    """How many runs there are at a time, and where their results are kept."""
    one.add_argument("--workers", type=int, default=2, help="runs at a time, one thread each")
    one.add_argument(
        "--memory",
        type=Path,
        default=Path(".experiments"),
        metavar="DIR",
        help="finished runs; what was interrupted goes on from them (default %(default)s)",
    )


def _add_calibration(commands: Commands) -> None:
    calibration = command(
        commands, "calibration", "Measure what a calibration finds and how much it helps.",
        "taxeld-hil calibration --quick --out calibration", run=_calibration,
    )  # fmt: skip
    calibration.add_argument(
        "--skin", action="append", metavar="SKIN", help="default: typical, poor"
    )
    calibration.add_argument("--seeds", type=int, metavar="N", help="random skins of each kind")
    calibration.add_argument(
        "--right-seeds", type=int, metavar="N", help="runs in which nothing is wrong"
    )
    _add_workers(calibration)
    calibration.add_argument("--quick", action="store_true", help="a smoke run of minutes")
    calibration.add_argument("--out", type=Path, help="directory for the JSON")
    calibration.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="instead: draw the calibration of one skin there",
    )


def _matrix(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import matrix
    from taxeld_hil.scenario import scenario as scenarios

    names = args.scenario or list(scenarios.shipped())
    objects, skins = args.object or OBJECTS, args.skin or args.skins
    todo = matrix.jobs(names, objects, skins, args.seeds, real=args.real)
    runs = _run(todo, args, matrix.described, "scenarios.json")
    for line in matrix.lines(runs):
        print(line)
    return 0 if all(run["passed"] for run in runs) else 1


def _touches(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import touch_experiment as touches

    todo = touches.jobs(args.object or OBJECTS, args.skin or args.skins, args.seeds)
    runs = _run(todo, args, touches.described, "touches.json")
    for line in touches.lines(runs):
        print(line)
    return 0


def _run(
    todo: "list[Job]", args: argparse.Namespace, describe: Callable[[Any], str], name: str
) -> list[dict[str, Any]]:
    """The jobs' results, which are also saved under this name in the directory `--out`."""
    from taxeld_hil import jobs
    from taxeld_hil.experiment import measurement

    done = jobs.run(todo, args.memory, workers=args.workers, dask=args.dask, describe=describe)
    runs = [done[job.name] for job in todo]
    measurement.save(args.out / name, runs)
    return runs


def _calibration(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.calibration_experiment import QUICK_SEEDS, Plan, experiment, lines

    if args.picture:
        return _calibration_picture(args)
    if not args.out:
        raise SetupError("--out: is required, unless --picture is given")
    quick = QUICK_SEEDS if args.quick else None
    plan = Plan(
        skins=tuple(args.skin or Plan.skins),
        seeds=args.seeds or quick or Plan.seeds,
        right_seeds=args.right_seeds or quick or Plan.right_seeds,
    )

    path = experiment(plan, args.out, args.memory, args.workers)
    for line in (str(path), *lines(path)):
        print(line)
    return 0


def _calibration_picture(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.calibration_experiment import pictured

    skin = args.skin[0] if args.skin else "typical"
    from taxeld_hil.calibration.picture import draw

    draw(pictured(skin), args.picture)
    print(args.picture)
    return 0
