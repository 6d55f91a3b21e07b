"""`taxeld-hil expect`, `matrix` and `soak`: measurements of many runs."""

import argparse
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from taxeld.command_line import Commands, documented
from taxeld.errors import SetupError
from taxeld_hil import jobs, options
from taxeld_hil.jobs import Job
from taxeld_hil.scenario.mesh_config import FOAMS

OBJECTS = ("box", "mug")  # bundles
FOAMS_OF_MATRIX = ("scene", "typical", "poor")


def add(commands: Commands) -> None:
    """Add all three commands."""
    _of_expect(documented(commands, _expect))

    matrix = documented(commands, _matrix)
    matrix.add_argument("scenario", nargs="*", metavar="SCENARIO", help="default: all shipped")
    about = f"default: {', '.join(OBJECTS)}"
    matrix.add_argument("--object", action="append", metavar="BUNDLE", help=about)
    options.add_layouts(matrix, "what each object's bundle was built for")
    about = f"default: {', '.join(FOAMS_OF_MATRIX)}"
    matrix.add_argument("--foam", action="append", help=about)
    _add_seeds(matrix, 5)
    options.add_workers(matrix)
    matrix.add_argument("--out", type=Path, required=True, metavar="DIR", help="for the JSON")
    _of_soak(documented(commands, _soak))


def _of_expect(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    about = "a bundle (box, drill, mug, a path), a YCB id or a mesh file"
    add("--object", required=True, help=about)
    about = "as skin.layout; default: what a bundle was built for"
    add("--layout", default="", help=about)
    add("--foam", default="typical", help=f"default: typical; {', '.join(FOAMS)}")
    about = "the robot's error in x and in y, sd, drawn for each touch (default %(default)s)"
    add("--robot-mm", type=float, default=1.0, metavar="SD", help=about)
    about = "the sensor frame's origin above the object's lowest point (default: as it fits)"
    add("--height-m", type=float, metavar="H", help=about)
    about = "of the foam, at full scale (default: 5, or the bundle's)"
    add("--depth-mm", type=float, metavar="D", help=about)
    add("--touches", type=int, default=8, metavar="N", help="default %(default)s")
    about = "begin no run after so long; the same command goes on (default %(default)s)"
    add("--minutes", type=float, default=4.0, help=about)
    about = "try whether it works: 2 seeds of 3 touches"
    add("--quick", action="store_true", help=about)
    _add_seeds(made, 60)
    options.add_jobs(made)
    add("--out", type=Path, metavar="DIR", help="for the JSON")


def _of_soak(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("scenario", nargs="?", default="demo", metavar="SCENARIO", help="default: demo")
    about = "in place of the scenario's object: box, drill, mug, or a path"
    add("--object", default="", metavar="BUNDLE", help=about)
    add("--foam", default="", help=f"in place of the scenario's: {', '.join(FOAMS)}")
    options.add_layouts(made, "the scenario's")
    add("--seed", type=int, default=0)
    long = made.add_mutually_exclusive_group().add_argument
    long("--hours", type=float, default=1.0, help="hours of scans, on the fake clock")
    long("--real-minutes", type=float, help="minutes over the transport, in real time")
    options.add_workers(made)
    add("--out", type=Path, default=Path("soak.json"), help="the report")


def _add_seeds(made: argparse.ArgumentParser, seeds: int) -> None:
    about = "runs of each kind (default %(default)s)"
    made.add_argument("--seeds", type=int, default=seeds, metavar="N", help=about)


def _expect(args: argparse.Namespace) -> int:
    """Say how well an object will be found with a skin, before it is bought.

    taxeld-hil expect --object box --layout skin.json
    taxeld-hil expect --object bracket.stl --layout skin.json --foam poor --robot-mm 2
    """
    from taxeld_hil.experiment import expect
    from taxeld_hil.world.conditions import Conditions
    from taxeld_hil.world.subjects import Subject

    until = time.monotonic() + 60.0 * args.minutes
    seeds, touches = (2, 3) if args.quick else (args.seeds, args.touches)
    for option, value in (("--seeds", seeds), ("--touches", touches)):
        if value < 1:
            raise SetupError(f"{option} must be at least 1")
    depth_m = None if args.depth_mm is None else 1e-3 * args.depth_mm
    subject = Subject(args.object, height_m=args.height_m, depth_m=depth_m)
    given = Conditions(foam=args.foam, robot_m=1e-3 * args.robot_mm, robot_told=True)
    made = expect.cases(subject, args.layout, given, touches, args.memory / "expect")
    todo = expect.jobs(made, seeds)
    runs = _done(todo, args, expect.described, until)
    for line in expect.written(made[expect.AS_IS], runs, args.out or Path("expect")):
        print(line)
    if len(runs) < len(todo):
        print(f"{len(runs)} of {len(todo)} runs in {args.minutes:g} minutes; again for more")
    return 0


def _matrix(args: argparse.Namespace) -> int:
    """Run scenarios on several objects and skins, seed by seed.

    taxeld-hil matrix demo --seeds 2 --out matrix
    """
    from taxeld_hil.experiment import matrix, measurement
    from taxeld_hil.scenario import scenario as scenarios

    names = args.scenario or list(scenarios.shipped())
    objects, foams = args.object or OBJECTS, args.foam or FOAMS_OF_MATRIX
    layouts = options.layouts(args.layout)
    todo = matrix.jobs(names, objects, foams, args.seeds, layouts)
    runs = _done(todo, args, matrix.described)
    measurement.save(args.out / "scenarios.json", runs)
    print("\n".join(matrix.lines(runs)))
    return 0 if all(run["passed"] for run in runs) else 1


def _soak(args: argparse.Namespace) -> int:
    """Run random faults for hours, on one daemon for each layout.

    taxeld-hil soak --hours 2
    taxeld-hil soak --real-minutes 10
    """
    from taxeld_hil.experiment import measurement, soak
    from taxeld_hil.scenario import scenario as scenarios

    base = scenarios.load(args.scenario).touching(args.object)
    subjects = [base.on(args.foam, layout) for layout in options.layouts(args.layout)]
    real = args.real_minutes is not None
    hours = args.real_minutes / 60.0 if real else args.hours
    args.workers = 1 if real else args.workers
    runs = _done(soak.jobs(subjects, args.seed, hours, real=real), args, soak.described)
    measurement.save(args.out, runs)
    print("\n".join(map(soak.described, runs)))
    return 0 if all(map(soak.passed, runs)) else 1


def _done(
    todo: list[Job],
    args: argparse.Namespace,
    describe: Callable[[Any], str],
    until: float = math.inf,
) -> list[dict[str, Any]]:
    """The results of the jobs that were begun until then (monotonic clock [s])."""
    how = {"workers": args.workers, "until": until, "describe": describe}
    done = jobs.run(todo, args.memory, **how)
    return [done[job.name] for job in todo if done[job.name] is not None]
