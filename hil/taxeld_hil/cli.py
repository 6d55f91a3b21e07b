"""`taxeld-hil`: the harness's commands."""

import argparse
import math
import shlex
import shutil
import sys
import tempfile
import textwrap
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import command_line
from taxeld.command_line import Arguments, Run, flag, given, natural
from taxeld.config import endpoints
from taxeld.errors import SetupError
from taxeld_sim import jobs
from taxeld_sim.world.mesh_config import FOAMS

if TYPE_CHECKING:
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
    taxeld-hil run demo --random 20
    """
    from taxeld_hil.grade import grade
    from taxeld_hil.run.fake import FakeRun
    from taxeld_hil.run.live import LiveRun
    from taxeld_hil.scenario import random_faults

    scenario = _scenario(args, args.foam, *args.layout or ())
    scenario = replace(scenario, advised=scenario.advised or args.advised)
    if args.random is not None:
        scenario = random_faults.drawn(scenario, args.seed, args.random)
    name = Path(args.scenario).stem
    out = args.out or Path(tempfile.mkdtemp(prefix=f"taxeld-{name}-"))
    is_fake = args.clock == "fake"
    run = FakeRun(scenario, args.seed) if is_fake else LiveRun(scenario, args.seed, _say)
    _say(f"scenario {args.scenario}, seed {args.seed}: session in {out}")
    graded = run.graded(name, out)
    _say("\n".join(grade.lines(graded)))
    _say_next(scenario, out)
    return 0 if graded.passed else 1


def _grade(args: argparse.Namespace) -> int:
    """Grade a session: of a run again, or what 'taxeld record' recorded on hardware.

    taxeld-hil grade session --truth 0.4 0.1 0
    """
    import numpy as np

    from taxeld_hil.grade import grade

    graded = grade.grade(args.session, None if args.truth is None else np.array(args.truth))
    _say("\n".join(grade.lines(graded)))
    return 0 if graded.passed else 1


def _say_next(scenario: "Scenario", out: Path) -> None:
    """How to see the session, and how to go on with its bundle."""
    _say(f"see it: {_command('taxeld', 'view', out)}")
    if scenario.links > 1:
        return  # their configuration is in the session
    more = ["--bundle", scenario.bundle]
    more += ["--layout", scenario.layout] if scenario.layout else []
    source = "array:tcp://127.0.0.1:9870" if scenario.transport == "array" else "can:can0"
    _say(f"next: {_command('taxeld', 'init', 'robot.toml', '--source', source, *more)}")


def _command(program: str, *words: object) -> str:
    """A command line to copy; with the program's path, where no shell finds it."""
    beside = Path(sys.argv[0]).with_name(program)
    found = str(beside) if shutil.which(program) is None and beside.is_file() else program
    return shlex.join(map(str, [found, *words]))


def _accept(args: argparse.Namespace) -> int:
    """Judge a real skin by a recording: at rest at first, then with each module pressed.

    taxeld-hil accept session
    taxeld-hil accept session --layout skin.json
    """
    from taxeld_hil import rules
    from taxeld_hil.acceptance.accept import of_session

    found = of_session(args.session, args.layout)
    failed = rules.failed(found)
    _say("\n".join(rules.lines(found)))
    _say(f"FAILED, {len(failed)} of {len(found)} rules" if failed else "PASSED")
    return 1 if failed else 0


def _expect(args: argparse.Namespace) -> int:
    """Say how well an object will be found with a skin, before it is bought.

    taxeld-hil expect --object box --layout skin.json
    taxeld-hil expect --object bracket.stl --layout skin.json --foam poor --robot-mm 2
    """
    from taxeld_hil.experiment import expect
    from taxeld_sim.answers.played import played
    from taxeld_sim.world.conditions import Conditions
    from taxeld_sim.world.subjects import Subject

    for option, value in (("--seeds", args.seeds), ("--touches", args.touches)):
        if value < 1:
            raise SetupError(f"{option} must be at least 1")
    depth_m = None if args.depth_mm is None else 1e-3 * args.depth_mm
    subject = Subject(args.object, height_m=args.height_m, depth_m=depth_m)
    conditions = Conditions(foam=args.foam, robot_m=1e-3 * args.robot_mm, robot_told=True)
    cells = expect.cells(subject, args.layout, conditions, args.touches, jobs.MEMORY / "expect")
    seeds = expect.QUICK if args.quick else args.seeds
    trials, names = len(cells) * seeds, ", ".join(str(each.labels["cell"]) for each in cells)
    minutes = math.ceil(trials * expect.TRIAL_S / 60.0)
    _say(f"{trials} trials of {seeds} seeds ({names}): {minutes} minutes of a core")
    run = partial(jobs.run, memory=jobs.MEMORY, workers=args.workers)
    done = played(cells, range(seeds), run)
    _say("\n".join(expect.written(cells[0].case, done, args.out)))
    return 0


def _matrix(args: argparse.Namespace) -> int:
    """Run scenarios on several objects and skins, seed by seed.

    taxeld-hil matrix demo --seeds 2 --out matrix
    taxeld-hil matrix demo --random 1 --seeds 60 --out soak
    """
    from taxeld_hil.experiment import runs
    from taxeld_hil.scenario import scenario as scenarios
    from taxeld_sim import jobs

    names = args.scenario or list(scenarios.shipped())
    objects, foams = args.object or MATRIX_OBJECTS, args.foam or MATRIX_FOAMS
    layouts = jobs.layouts(args.layout)
    todo = runs.matrix(names, objects, foams, args.seeds, layouts, args.random or 0)
    done = jobs.run(todo, jobs.MEMORY, workers=args.workers, describe=runs.described)
    rows = [done[job.name] for job in todo]
    jobs.save(args.out / "scenarios.json", "runs", rows, {})
    passed = sum(row["passed"] for row in rows)
    _say(f"{passed} of {len(rows)} runs passed")
    return 0 if passed == len(rows) else 1


def _emulate(args: argparse.Namespace) -> int:
    """Run the virtual skin and robot alone, for a daemon of yours.

    taxeld-hil emulate demo --link /tmp/skin --poses tcp://127.0.0.1:9874 --out emulated
    """
    from taxeld_hil.run.live import emulate

    fault = endpoints.fault(args.poses, has_keys=True)
    if fault:
        raise SetupError(f"--poses: {fault}")
    scenario = _scenario(args, "").over("can" if args.can else "")
    if emulate(scenario, args.seed, args.poses, args.can or args.link, args.out):
        return 0
    print("no host started the skin, or it stopped it before the end", file=sys.stderr)
    return 1


def _scenario(args: argparse.Namespace, foam: str, *layouts: str) -> "Scenario":
    """The scenario that the arguments name, with their object, this foam and these layouts.

    Raises:
        SetupError: there is no such scenario or foam.
    """
    from taxeld_hil.scenario import scenario as scenarios

    return scenarios.load(args.scenario).touching(args.object).on(foam, *layouts)


SCENARIO = given("scenario", "SCENARIO", "a shipped name (demo) or a TOML file")
SEED = given("--seed", "N", "default: 0", natural, default=0)
OBJECT_ABOUT = "in place of the scenario's object: box, drill, mug, or a path"
OBJECT = given("--object", "BUNDLE", OBJECT_ABOUT, default="")
RANDOM_ABOUT = "of faults that the seed draws, in place of the scenario's"
RANDOM = given("--random", "MINUTES", RANDOM_ABOUT, int)
FOAM_NAMES = ", ".join(FOAMS)

COMMANDS: dict[Run, Arguments] = {
    _run: (
        SCENARIO,
        SEED,
        OBJECT,
        given("--out", "DIR", "for the session and its grade", Path),
        given("--foam", "FOAM", f"in place of the scenario's: {FOAM_NAMES}", default=""),
        given("--clock", "CLOCK", "real or fake", choices=("real", "fake"), default="real"),
        flag("--advised", "the robot follows the daemon's advice, on the fake clock"),
        given("--layout", "LAYOUT", "in place of the scenario's; of a link each", action="append"),
        RANDOM,
    ),
    _grade: (
        given("session", "SESSION", "its directory", Path),
        given("--truth", "X Y THETA", "the object's true pose [m, m, rad]", float),
    ),
    _accept: (
        given("session", "SESSION", "what taxeld record wrote", Path),
        given("--layout", "LAYOUT", "in place of the session's, which lacks its file", default=""),
    ),
    _expect: (
        given("--object", "OBJECT", "a bundle, a YCB id or a mesh file", required=True),
        given("--layout", "LAYOUT", "as skin.layout (what a bundle was built for)", default=""),
        given("--foam", "FOAM", f"{FOAM_NAMES} (typical)", default="typical"),
        given("--robot-mm", "SD", "of the robot's error in x and y (1)", float, default=1.0),
        given("--height-m", "H", "the sensor frame's, over the object's foot (as it fits)", float),
        given("--depth-mm", "D", "of the foam, at full scale (5, or the bundle's)", float),
        given("--touches", "N", "default: 8", int, default=8),
        [
            given("--seeds", "N", "trials of each kind (40)", int, default=40),
            flag("--quick", "10 of them: a quarter of the time, and less is shown"),
        ],
        jobs.WORKERS,
        given("--out", "DIR", "for the JSON", Path, default=Path("expect")),
    ),
    _matrix: (
        given("scenario", "SCENARIO", "default: all shipped", nargs="*"),
        given(
            "--object", "BUNDLE", f"may be repeated ({', '.join(MATRIX_OBJECTS)})", action="append"
        ),
        given("--foam", "FOAM", f"may be repeated ({', '.join(MATRIX_FOAMS)})", action="append"),
        jobs.layout_option("what each object's bundle was built for"),
        given("--seeds", "N", "runs of each kind (5)", int, default=5),
        RANDOM,
        jobs.WORKERS,
        given("--out", "DIR", "for the JSON", Path, required=True),
    ),
    _emulate: (
        SCENARIO,
        SEED,
        OBJECT,
        [
            given("--link", "PATH", "that will be a link to the virtual SLCAN adapter", Path),
            given("--can", "INTERFACE", "of this machine, such as vcan0"),
        ],
        given("--poses", "ENDPOINT", "for the robot's poses", required=True),
        given("--out", "DIR", "for the session", Path, required=True),
    ),
}


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-hil",
        "The test harness: a simulated skin and robot around a daemon, and a grade for sessions."
        f"\n\n{textwrap.fill('Scenarios: ' + ', '.join(SCENARIOS), 80)}."
        f"\n\nFoams of the simulated skin: {FOAM_NAMES}.",
        "taxeld-hil run demo",
        "taxeld-hil accept session",
    )
    command_line.add_commands(parser, COMMANDS)
    return parser


if __name__ == "__main__":
    sys.exit(main())
