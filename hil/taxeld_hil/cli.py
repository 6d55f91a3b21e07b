"""`taxeld-hil`: the harness's commands."""

import argparse
import shlex
import shutil
import sys
import tempfile
import textwrap
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import command_line
from taxeld.config import endpoints
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil.experiment import cli as measurements
from taxeld_hil.scenario.mesh_config import FOAMS

if TYPE_CHECKING:
    from taxeld_hil.scenario.scenario import Scenario

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
    from taxeld_hil.grade import grade
    from taxeld_hil.run import live
    from taxeld_hil.run.fake_run import FakeRun

    is_simulated = args.target == "sim"
    if args.png and not is_simulated:
        raise SetupError("--png: a run on hardware records no session to show")
    if args.png:
        from taxeld_hil.run import picture
    scenario = _scenario(args)
    if args.advised:
        scenario = replace(scenario, advised=True)
    name = Path(args.scenario).stem
    out = args.out or Path(tempfile.mkdtemp(prefix=f"taxeld-{name}-"))
    run: live.LiveRun | FakeRun
    if not is_simulated:
        run = live.HardwareRun(scenario, args.target, args.poses, args.truth, _say)
    elif args.clock == "fake":
        run = FakeRun(scenario, args.seed)
    else:
        run = live.SimulatedRun(scenario, args.seed, _say)
    _say(f"scenario {args.scenario}, seed {args.seed}: session in {out}")
    with run:
        graded = run.graded(name, out)
    _say("\n".join(grade.lines(graded)))
    if args.png:
        picture.draw(out, args.png)
    if is_simulated:
        _say_next(args, scenario, out)
    return 0 if graded.passed else 1


def _say_next(args: argparse.Namespace, scenario: "Scenario", out: Path) -> None:
    """How to see the session, by Rerun or by matplotlib alone, and how to go on with its bundle."""
    _say(f"see it: {_command('taxeld', 'view', out)}")
    if not args.png:
        given = [args.scenario, "--seed", args.seed]
        for option, value in (("--object", args.object), ("--foam", args.foam)):
            given += [option, value] if value else []
        for layout in args.layout or ():
            given += ["--layout", layout]
        given += ["--advised"] * args.advised
        png = f"{Path(args.scenario).stem}.png"
        _say(f"draw it: {_command('taxeld-hil', 'run', *given, '--clock', 'fake', '--png', png)}")
    if scenario.links > 1:
        return  # their configuration is in the session
    given = ["--bundle", scenario.bundle]
    given += ["--layout", scenario.layout] if scenario.layout else []
    _say(f"next: {_command('taxeld', 'init', 'robot.toml', '--source', 'can:can0', *given)}")


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


def _scenario(args: argparse.Namespace) -> "Scenario":
    """The scenario that the arguments name, with their object, foam and layout.

    Raises:
        SetupError: there is no such scenario or foam.
    """
    from taxeld_hil.scenario import scenario as scenarios

    layouts = [args.layout] if isinstance(args.layout, str) else args.layout or ()
    return scenarios.load(args.scenario).touching(args.object).on(args.foam, *layouts)


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
    add = partial(command_line.documented, commands)
    _of_run(add(_run))
    _of_accept(add(_accept))
    measurements.add(commands)
    _of_emulate(add(_emulate))
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
    about = "draw how the object was found: four moments of the session"
    add("--png", type=Path, metavar="OUT", help=about)
    about = "in place of the scenario's, as skin.layout; each of several is of a link"
    add("--layout", action="append", help=about)


def _of_accept(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    about = "can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, …"
    add("target", metavar="TARGET", help=about)
    add("--layout", required=True, help="the layout of this skin, as skin.layout")
    add("--out", type=Path, help="directory for the report")
    about = "seconds to listen while nothing touches the skin"
    add("--seconds", type=float, default=15.0, help=about)
    add("--press", action="store_true", help="then ask for a press on each module")
    add("--period-ms", type=int, default=50, help="milliseconds between scans")
    counts, about = SkinConfig().full_scale_counts, "as skin.full_scale_counts"
    add("--full-scale-counts", type=float, default=counts, help=about)


def _of_emulate(made: argparse.ArgumentParser) -> None:
    add = made.add_argument
    _add_scenario(made)
    add("--layout", default="", help="in place of the scenario's, as skin.layout")
    made.set_defaults(foam="")
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
