"""`taxeld-hil matrix`, `physics` and `calibration`: measurements of many runs."""

import argparse
import sys
from pathlib import Path

from taxeld.command_line import Commands, command
from taxeld.errors import SetupError


def add(commands: Commands) -> None:
    """All three commands."""
    _add_matrix(commands)
    _add_physics(commands)
    _add_calibration(commands)


def _add_matrix(commands: Commands) -> None:
    matrix = command(
        commands, "matrix", "Run scenarios on several objects and skins, seed by seed.",
        "taxeld-hil matrix demo --seeds 2 --out matrix", run=_matrix,
    )  # fmt: skip
    matrix.add_argument("scenario", nargs="*", metavar="SCENARIO", help="default: all shipped")
    matrix.add_argument("--object", action="append", metavar="BUNDLE", help="default: box and mug")
    matrix.add_argument("--skin", action="append", help="default: scene, typical and poor")
    matrix.add_argument("--seeds", type=int, default=5)
    matrix.add_argument(
        "--real", action="store_true",
        help="run the scenarios whose faults need real time in real time",
    )  # fmt: skip
    matrix.add_argument("--workers", type=int, default=2, help="runs at a time, one thread each")
    matrix.add_argument(
        "--memory", type=Path, default=Path(".experiments/scenarios.jsonl"), metavar="FILE",
        help="finished runs; what was interrupted goes on from them (default %(default)s)",
    )  # fmt: skip
    matrix.add_argument("--out", type=Path, required=True, help="directory for scenarios.json")


def _add_physics(commands: Commands) -> None:
    physics = command(
        commands, "physics", "Compare the estimator's model with simulated soft skins.",
        "taxeld-hil physics --quick --out physics", run=_physics,
    )  # fmt: skip
    other = physics.add_mutually_exclusive_group()
    other.add_argument(
        "--touches",
        action="store_true",
        help="instead: runs of ten touches, and how well the object is found",
    )
    other.add_argument(
        "--curves", action="store_true", help="instead: the named skins beside recordings' bands"
    )
    other.add_argument(
        "--fit", type=Path, metavar="DATA", help="instead: what recordings of an insole (*.mat) say"
    )
    physics.add_argument("--object", action="append", metavar="BUNDLE", help="default: box and mug")
    physics.add_argument(
        "--skin",
        action="append",
        metavar="SKIN",
        help="skin; may be given several times with --touches and --curves (default typical)",
    )
    physics.add_argument(
        "--workers", type=int, default=2, help="runs of --touches at a time, one thread each"
    )
    physics.add_argument(
        "--memory", type=Path, default=Path(".experiments/touches.jsonl"), metavar="FILE",
        help="finished runs of --touches; what was interrupted goes on (default %(default)s)",
    )  # fmt: skip
    physics.add_argument("--contacts", type=int, metavar="N", help="an object, to compare readings")
    physics.add_argument(
        "--seeds", type=int, metavar="N", help="runs of --touches; skins of --curves"
    )
    physics.add_argument("--seed", type=int, help="of the random contacts")
    physics.add_argument("--noise-sigma", type=float, metavar="SD", help="default: the daemon's")
    physics.add_argument("--quick", action="store_true", help="a smoke run of seconds")
    physics.add_argument("--out", type=Path, required=True, help="directory for JSON and PNG")


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
    calibration.add_argument(
        "--workers", type=int, default=2, help="runs at a time, one thread each"
    )
    calibration.add_argument(
        "--memory", type=Path, default=Path(".experiments/calibration.jsonl"), metavar="FILE",
        help="finished runs; what was interrupted goes on from them (default %(default)s)",
    )  # fmt: skip
    calibration.add_argument("--quick", action="store_true", help="a smoke run of minutes")
    calibration.add_argument("--out", type=Path, help="directory for the JSON")
    calibration.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="instead: draw the calibration of one skin there",
    )


def _matrix(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.matrix import Plan, experiment, lines
    from taxeld_hil.scenario import scenario as scenarios

    names = tuple(args.scenario or scenarios.shipped())
    plan = Plan(
        scenarios=names,
        objects=tuple(args.object or Plan.objects),
        skins=tuple(args.skin or Plan.skins),
        seeds=args.seeds,
        real=args.real,
    )
    outcomes = experiment(plan, args.out, args.memory, args.workers, _progress)
    for line in lines(outcomes):
        print(line)
    return 0 if all(outcome.passed for outcome in outcomes) else 1


def _physics(args: argparse.Namespace) -> int:
    if args.touches:
        return _touches(args)
    if args.curves:
        return _curves(args)
    if args.fit is not None:
        return _fit(args)
    from taxeld_hil.experiment.physics_experiment import Plan, experiment, lines

    plan = Plan.quick if args.quick else Plan
    given = {
        "skin": args.skin[0] if args.skin else None,
        "contacts": args.contacts,
        "seed": args.seed,
        "noise_sigma": args.noise_sigma,
    }
    objects = tuple(args.object or ("box", "mug"))
    chosen = plan(objects=objects, **{k: v for k, v in given.items() if v is not None})
    paths = list(experiment(chosen, args.out, _progress))
    for line in (*map(str, paths), *lines(paths[0])):
        print(line)
    return 0


def _touches(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.touch_experiment import QUICK_SEEDS, Plan, experiment, lines, read

    plan = Plan(
        objects=tuple(args.object or Plan.objects),
        skins=tuple(args.skin or Plan.skins),
        seeds=args.seeds or (QUICK_SEEDS if args.quick else Plan.seeds),
    )
    path = experiment(plan, args.out, args.memory, args.workers, _progress)
    print(path)
    for line in lines(read(path)):
        print(line)
    return 0


def _calibration(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.calibration_experiment import QUICK_SEEDS, Plan, experiment
    from taxeld_hil.experiment.calibration_tables import lines

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

    path = experiment(plan, args.out, args.memory, args.workers, _progress)
    for line in (str(path), *lines(path)):
        print(line)
    return 0


def _calibration_picture(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment.calibration_experiment import pictured

    skin = args.skin[0] if args.skin else "typical"
    from taxeld.commands.calibration_draw import draw

    draw(pictured(skin), args.picture)
    print(args.picture)
    return 0


def _curves(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import curves

    names = tuple(args.skin or ("typical", "poor", "stiff"))
    skins = args.seeds or (curves.QUICK_SKINS if args.quick else curves.SKINS)
    paths = list(curves.experiment(names, skins, args.out, _progress))
    for line in (*map(str, paths), *curves.lines(paths[0])):
        print(line)
    return 0


def _fit(args: argparse.Namespace) -> int:
    from taxeld_hil.experiment import insole

    fits = insole.fit(args.fit)
    if not fits:
        _progress(f"{args.fit}: no recordings (*.mat) there; nothing is fitted")
        return 0
    args.out.mkdir(parents=True, exist_ok=True)
    insole.write(args.out / "insole.json", fits)
    for line in (str(args.out / "insole.json"), *insole.lines(fits)):
        print(line)
    return 0


def _progress(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
