"""`taxeld-hil`: the harness's commands."""

import argparse
import shlex
import shutil
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taxeld import command_line
from taxeld.config import endpoints
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import options
from taxeld_hil.scenario.mesh_config import FOAMS

if TYPE_CHECKING:
    from taxeld_hil.jobs import Job
    from taxeld_hil.scenario.scenario import Scenario

MATRIX_OBJECTS, MATRIX_FOAMS = ("box", "mug"), ("scene", "typical", "poor")
SCENARIOS = sorted(path.stem for path in (Path(__file__).parent / "scenarios").glob("*.toml"))

_say = partial(print, flush=True)


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    """Run a scenario with all its processes, and grade the daemon.

    taxeld-hil run demo
    taxeld-hil run everything --clock fake --foam poor
    taxeld-hil run demo --target can:can0 --poses tcp://127.0.0.1:9874 --truth 0.4 0.1 0
    """
    import numpy as np

    from taxeld_hil.grade import grade
    from taxeld_hil.run import live
    from taxeld_hil.run.fake import FakeRun

    is_simulated = args.target == "sim"
    scenario = _scenario(args, *args.layout or ())
    name = Path(args.scenario).stem
    out = args.out or Path(tempfile.mkdtemp(prefix=f"taxeld-{name}-"))
    run: live.LiveRun | FakeRun
    if not is_simulated:
        truth = None if args.truth is None else np.array(args.truth)
        run = live.LiveRun(scenario, args.target, args.poses, truth, _say)
    elif args.clock == "fake":
        run = FakeRun(scenario, args.seed)
    else:
        run = live.SimulatedRun(scenario, args.seed, _say)
    _say(f"scenario {args.scenario}, seed {args.seed}: session in {out}")
    graded = run.graded(name, out)
    _say("\n".join(grade.lines(graded)))
    if is_simulated:
        _say_next(scenario, out)
    return 0 if graded.passed else 1


def _say_next(scenario: "Scenario", out: Path) -> None:
    """How to see the session, and how to go on with its bundle."""
    _say(f"see it: {_command('taxeld', 'view', out)}")
    if scenario.links > 1:
        return  # their configuration is in the session
    given = ["--bundle", scenario.bundle]
    given += ["--layout", scenario.layout] if scenario.layout else []
    source = "array:tcp://127.0.0.1:9870" if scenario.transport == "array" else "can:can0"
    _say(f"next: {_command('taxeld', 'init', 'robot.toml', '--source', source, *given)}")


def _command(program: str, *words: object) -> str:
    """A command line to copy; with the program's path, where no shell finds it."""
    beside = Path(sys.argv[0]).with_name(program)
    found = str(beside) if shutil.which(program) is None and beside.is_file() else program
    return shlex.join(map(str, [found, *words]))


def _accept(args: argparse.Namespace) -> int:
    """Check a real skin before it is used; no object is needed.

    taxeld-hil accept can:can0 --layout skin.json
    taxeld-hil accept slcan:/dev/ttyACM0 --layout skin.json --press
    """
    from taxeld_hil.acceptance.accept import run

    passed = run(
        args.target,
        args.layout,
        args.out or Path(time.strftime("acceptance-%Y%m%d-%H%M%S")),
        _say,
        seconds=args.seconds,
        period_ms=args.period_ms,
        full_scale_counts=args.full_scale_counts,
        presses=args.press,
    )
    return 0 if passed else 1


def _expect(args: argparse.Namespace) -> int:
    """Say how well an object will be found with a skin, before it is bought.

    taxeld-hil expect --object box --layout skin.json
    taxeld-hil expect --object bracket.stl --layout skin.json --foam poor --robot-mm 2
    """
    from taxeld_hil.experiment import expect
    from taxeld_hil.world.conditions import Conditions
    from taxeld_hil.world.subjects import Subject

    for option, value in (("--seeds", args.seeds), ("--touches", args.touches)):
        if value < 1:
            raise SetupError(f"{option} must be at least 1")
    depth_m = None if args.depth_mm is None else 1e-3 * args.depth_mm
    subject = Subject(args.object, height_m=args.height_m, depth_m=depth_m)
    given = Conditions(foam=args.foam, robot_m=1e-3 * args.robot_mm, robot_told=True)
    made = expect.cases(subject, args.layout, given, args.touches, args.memory / "expect")
    runs = _done(expect.jobs(made, args.seeds), args, expect.described)
    _say("\n".join(expect.written(made[expect.AS_IS], runs, args.out)))
    return 0


def _matrix(args: argparse.Namespace) -> int:
    """Run scenarios on several objects and skins, seed by seed.

    taxeld-hil matrix demo --seeds 2 --out matrix
    """
    from taxeld_hil.experiment import runs
    from taxeld_hil.scenario import scenario as scenarios

    names = args.scenario or list(scenarios.shipped())
    objects, foams = args.object or MATRIX_OBJECTS, args.foam or MATRIX_FOAMS
    layouts = options.layouts(args.layout)
    rows = _done(runs.matrix(names, objects, foams, args.seeds, layouts), args, runs.described)
    runs.save(args.out / "scenarios.json", rows)
    _say("\n".join(runs.lines(rows)))
    return 0 if all(row["passed"] for row in rows) else 1


def _soak(args: argparse.Namespace) -> int:
    """Run random faults for hours, lap by lap, or in real time on one daemon.

    taxeld-hil soak --hours 2
    taxeld-hil soak mine.toml --real-minutes 10
    """
    from taxeld_hil.experiment import runs, soak
    from taxeld_hil.scenario import scenario as scenarios

    real = args.real_minutes is not None
    minutes = args.real_minutes if real else round(60.0 * args.hours)
    if not 1 <= minutes <= (soak.LIVE_MAX if real else minutes):
        most = f"--real-minutes must be 1..{soak.LIVE_MAX}" if real else "--hours is too short"
        raise SetupError(most)
    todo = soak.jobs(scenarios.load(args.scenario), args.seed, minutes, real=real)
    rows = _done(todo, args, runs.described)
    runs.save(args.out, rows)
    _say(soak.described(rows))
    return 0 if soak.passed(rows) else 1


def _done(
    todo: "list[Job]", args: argparse.Namespace, describe: Callable[[Any], str]
) -> list[dict[str, Any]]:
    """The results of jobs, in their order."""
    from taxeld_hil import jobs

    done = jobs.run(todo, args.memory, workers=args.workers, describe=describe)
    return [done[job.name] for job in todo]


def _emulate(args: argparse.Namespace) -> int:
    """Run the virtual skin and robot alone, for a daemon of yours.

    taxeld-hil emulate demo --link /tmp/skin --poses tcp://127.0.0.1:9874 --out emulated
    """
    from taxeld_hil.run.live import emulate

    fault = endpoints.fault(args.poses, has_keys=True)
    if fault:
        raise SetupError(f"--poses: {fault}")
    scenario = _scenario(args).over("can" if args.can else "")
    if emulate(scenario, args.seed, args.poses, args.can or args.link, args.out):
        return 0
    print("no host started the skin, or it stopped it before the end", file=sys.stderr)
    return 1


def _scenario(args: argparse.Namespace, *layouts: str) -> "Scenario":
    """The scenario that the arguments name, with their object and foam, and these layouts.

    Raises:
        SetupError: there is no such scenario or foam.
    """
    from taxeld_hil.scenario import scenario as scenarios

    found = scenarios.load(args.scenario).touching(args.object).on(args.foam, *layouts)
    return replace(found, advised=found.advised or args.advised)


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-hil",
        "The test harness: a simulated or real skin and robot around a daemon, and a grade for it."
        f"\n\n{textwrap.fill('Scenarios: ' + ', '.join(SCENARIOS), 80)}."
        f"\n\nFoams of the simulated skin: {', '.join(FOAMS)}.",
        "taxeld-hil run demo",
        "taxeld-hil accept can:can0 --layout skin.json",
    )
    commands = command_line.commands_of(parser)
    for run, add_options in (
        (_run, _of_run),
        (_accept, _of_accept),
        (_expect, _of_expect),
        (_matrix, _of_matrix),
        (_soak, _of_soak),
        (_emulate, _of_emulate),
    ):
        add_options(command_line.documented(commands, run))
    return parser


def _of_run(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    _add_scenario(made)
    add("--out", type=Path, help="directory for the session and its grade")
    about = "sim, can:can0, serial:/dev/ttyACM0 or slcan:/dev/ttyACM0"
    add("--target", default="sim", help=about)
    add("--poses", default="", help="on hardware: the robot's endpoint")
    about = "on hardware: where the object is in the robot's world [m, m, rad]"
    add("--truth", type=float, nargs=3, metavar=("X", "Y", "THETA"), help=about)
    add("--foam", default="", help=f"in place of the scenario's: {', '.join(FOAMS)}")
    add("--clock", choices=("real", "fake"), default="real")
    about = "the robot follows the daemon's advice, on the fake clock"
    add("--advised", action="store_true", help=about)
    about = "in place of the scenario's, as skin.layout; each of several is of a link"
    add("--layout", action="append", help=about)


def _of_accept(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("target", metavar="TARGET", help="can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, …")
    add("--layout", required=True, help="the layout of this skin, as skin.layout")
    add("--out", type=Path, help="directory for the report")
    about = "seconds to listen while nothing touches the skin"
    add("--seconds", type=float, default=15.0, help=about)
    add("--press", action="store_true", help="then ask for a press on each module")
    add("--period-ms", type=int, default=50, help="milliseconds between scans")
    counts = SkinConfig().full_scale_counts
    add("--full-scale-counts", type=float, default=counts, help="as skin.full_scale_counts")


def _of_expect(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    about = "a bundle (box, drill, mug, a path), a YCB id or a mesh file"
    add("--object", required=True, help=about)
    add("--layout", default="", help="as skin.layout; default: what a bundle was built for")
    add("--foam", default="typical", help=f"default: typical; {', '.join(FOAMS)}")
    about = "the robot's error in x and in y, sd, drawn for each touch (default %(default)s)"
    add("--robot-mm", type=float, default=1.0, metavar="SD", help=about)
    about = "the sensor frame's origin above the object's lowest point (default: as it fits)"
    add("--height-m", type=float, metavar="H", help=about)
    about = "of the foam, at full scale (default: 5, or the bundle's)"
    add("--depth-mm", type=float, metavar="D", help=about)
    add("--touches", type=int, default=8, metavar="N", help="default %(default)s")
    add("--seeds", type=int, default=60, metavar="N", help="trials (default %(default)s)")
    options.add_workers(made)
    add("--out", type=Path, default=Path("expect"), metavar="DIR", help="for the JSON")


def _of_matrix(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("scenario", nargs="*", metavar="SCENARIO", help="default: all shipped")
    for option, default in (("--object", MATRIX_OBJECTS), ("--foam", MATRIX_FOAMS)):
        add(option, action="append", help=f"may be repeated; default: {', '.join(default)}")
    options.add_layouts(made, "what each object's bundle was built for")
    about = "runs of each kind (default %(default)s)"
    add("--seeds", type=int, default=5, metavar="N", help=about)
    options.add_workers(made)
    add("--out", type=Path, required=True, metavar="DIR", help="for the JSON")


def _of_soak(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    add("scenario", nargs="?", default="demo", metavar="SCENARIO", help="default: demo")
    add("--seed", type=int, default=0)
    long = made.add_mutually_exclusive_group().add_argument
    long("--hours", type=float, default=1.0, help="hours of scans, on the fake clock")
    long("--real-minutes", type=int, help="minutes over the transport, in real time")
    options.add_workers(made)
    add("--out", type=Path, default=Path("soak.json"), help="the report")


def _of_emulate(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    _add_scenario(made)
    made.set_defaults(foam="", advised=False)
    where = made.add_mutually_exclusive_group(required=True).add_argument
    where("--link", type=Path, help="path that will be a link to the virtual SLCAN adapter")
    where("--can", metavar="INTERFACE", help="CAN interface of this machine, such as vcan0")
    add("--poses", required=True, help="endpoint for the robot's poses")
    add("--out", type=Path, required=True, help="directory for the session")


def _add_scenario(made: argparse.ArgumentParser) -> None:
    """The scenario, its seed, and what replaces parts of it."""
    add = made.add_argument
    add("scenario", metavar="SCENARIO", help="a shipped name (demo) or a TOML file")
    add("--seed", type=int, default=0)
    about = "in place of the scenario's object: box, drill, mug, or a path"
    add("--object", default="", metavar="BUNDLE", help=about)


if __name__ == "__main__":
    sys.exit(main())
