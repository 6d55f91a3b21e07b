"""`taxeld-hil`: the harness's commands."""

import argparse
import math
import shlex
import shutil
import signal
import sys
import tempfile
import textwrap
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import cli as daemon_cli
from taxeld import command_line
from taxeld.command_line import Commands, command
from taxeld.config import endpoints
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import jobs
from taxeld_hil.experiment import cli as measurements
from taxeld_hil.scenario.mesh_config import FOAMS

if TYPE_CHECKING:
    from taxeld_hil.scenario.scenario import Scenario

VCAN = "vcan0"
SCENARIOS = sorted(path.stem for path in (Path(__file__).parent / "scenarios").glob("*.toml"))
GONE = {  # commands of earlier versions, and what replaced them
    "physics": "ten touches of a soft skin: taxeld-hil touches; what the simulated skins were "
    "fitted to: docs/physics.md",
}
WATCH_SILENT_S = 5.0  # without a message for so long, a line says so: daemons start in seconds


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    command_line.one_thread()
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] in GONE:
        print(f"taxeld-hil {argv[0]} is gone; {GONE[argv[0]]}", file=sys.stderr)
        return command_line.USAGE_ERROR
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    import numpy as np

    from taxeld_hil.grade import report
    from taxeld_hil.run import hardware
    from taxeld_hil.run.fake_run import FakeRun
    from taxeld_hil.run.live import LiveRun

    if args.view and args.target != "sim":
        raise SetupError("--view: a run on hardware records no session to show")
    transport, _, channel = args.transport.partition(":")
    scenario = _scenario(args).over(transport)
    if args.advised:
        scenario = replace(scenario, advised=True)
    if scenario.advised and args.target != "sim":
        raise SetupError("--advised: on hardware the robot is yours; taxeld advise tells it where")
    name = Path(args.scenario).stem
    out = args.out or Path(tempfile.mkdtemp(prefix=f"taxeld-{name}-"))
    _say(f"scenario {args.scenario}, seed {args.seed}: session in {out}")
    with tempfile.TemporaryDirectory(prefix="taxeld-") as place:
        if args.target != "sim":
            truth = None if args.truth is None else np.array(args.truth)
            site = hardware.Site(args.target, args.poses, truth, args.limit_s)
            grade = hardware.graded(name, scenario, site, out, Path(place), _say)
        elif args.clock == "fake":
            grade = FakeRun(scenario, args.seed).graded(name, out)
        else:
            run = LiveRun(name, scenario, args.seed, out, channel or VCAN, _say)
            grade = run.graded(Path(place))
    report.write(grade, out)
    for line in report.lines(grade):
        _say(line)
    if args.target == "sim":
        _say_next(args, scenario, out)
    return 0 if grade.passed else 1


def _say_next(args: argparse.Namespace, scenario: "Scenario", out: Path) -> None:
    """How to see the session, or the viewer itself; and how a daemon gets this bundle."""
    beside = Path(sys.argv[0]).with_name("taxeld")  # in a .venv that no shell has been told of
    program = str(beside) if shutil.which("taxeld") is None and beside.is_file() else "taxeld"
    if args.view:
        daemon_cli.main(["view", str(out)])  # where its extra lacks, it says so in a line
    else:
        _say(f"see it: {shlex.join([program, 'view', str(out)])}")
    if scenario.links > 1:
        return  # their configuration is in the session
    given = ["--bundle", scenario.bundle]
    if scenario.layout:
        given += ["--layout", scenario.layout]
    _say(f"next: {shlex.join([program, 'init', 'robot.toml', *given])}")


def _soak(args: argparse.Namespace) -> int:
    from taxeld_hil.grade import report
    from taxeld_hil.run.soak import Soak, lap_alone, resumed, soak_fake, soak_live, table

    if args.table:
        for line in table(args.table):
            _say(line)
        return 0
    real, passed = args.real_minutes is not None, True
    hours = args.real_minutes / 60.0 if real else args.hours
    if args.lap is not None and args.lap < 0:
        raise SetupError("--lap: must be at least 0")
    for layout in jobs.layouts(args.layout):
        base, name = _scenario(args, layout), jobs.layout_name(layout)
        if args.lap is not None:
            grade = lap_alone(base, args.seed, args.lap)
            for line in report.lines(grade):
                _say(line)
            passed &= grade.passed
            continue
        out = args.out.with_stem(f"{args.out.stem}_{name}") if name else args.out
        clock = "real" if real else "fake"
        asked = Soak(args.seed, clock, hours, faultless=args.no_faults, learns=not args.frozen)
        soak = resumed(out, base, asked)
        soak = (soak_live if real else soak_fake)(base, soak, out, _say)
        _say(soak.line())
        _say("passed" if soak.passed else f"failed; see failures in {out}")
        passed &= soak.passed
    return 0 if passed else 1


def _table(args: argparse.Namespace) -> int:
    from taxeld_hil.run.table import rows

    for row in rows(range(args.seeds), args.object, args.foam, args.layout):
        _say(row)
    return 0


def _emulate(args: argparse.Namespace) -> int:
    from taxeld_hil.run.emulate import emulate

    _check_endpoint("--poses", args.poses)
    scenario = _scenario(args).over("can" if args.can else "")
    if scenario.advised:
        raise SetupError(f"{args.scenario}: this robot hears no advice: taxeld-hil run has one")
    if emulate(scenario, args.seed, args.poses, args.can or args.link, args.out):
        return 0
    print("no host started the skin, or it stopped it before the end", file=sys.stderr)
    return 1


def _check_endpoint(option: str, endpoint: str) -> None:
    fault = endpoints.fault(endpoint, has_keys=True)
    if fault:
        raise SetupError(f"{option}: {fault}")


def _accept(args: argparse.Namespace) -> int:
    from taxeld_hil.acceptance.accept import SECONDS_MAX, SECONDS_MIN, run

    for option, value, least, most in (
        ("--seconds", args.seconds, SECONDS_MIN, SECONDS_MAX),
        ("--period-ms", args.period_ms, 1, 0xFFFF),
        ("--full-scale-counts", args.full_scale_counts, 1, 0xFFFF),
    ):
        if not least <= value <= most:
            raise SetupError(f"{option}: must be {least:g}..{most:g}, not {value:g}")
    out = args.out or Path(time.strftime("acceptance-%Y%m%d-%H%M%S"))
    report = run(
        args.target,
        args.layout,
        out,
        partial(print, flush=True),
        seconds=args.seconds,
        period_ms=args.period_ms,
        full_scale_counts=args.full_scale_counts,
        presses=args.press,
    )
    print(f"\n{report.text}\nreport, picture and recording in {out}", flush=True)
    return 1 if report.failed else 0


def _watch(args: argparse.Namespace) -> int:
    import numpy as np
    import zmq

    from taxeld.source import session
    from taxeld.stream import messages, sockets
    from taxeld_hil.run.watch import HEADER, ContactTable, receive
    from taxeld_hil.scenario.scenario import Scenario
    from taxeld_hil.world.world import load_model

    _check_endpoint("--endpoint", args.endpoint)
    scene = load_model(Scenario(args.bundle, args.layout)).scene
    truth = np.array(session.read_poses(args.truth)[-1][1:]) if args.truth else None
    table = ContactTable(scene, truth)
    stopping: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _: stopping.append(got))
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        sockets.connect(socket, args.endpoint, "--endpoint")
        for topic in (messages.ESTIMATE, messages.TAXELS):
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        begun, silent_s = False, time.monotonic() + WATCH_SILENT_S
        while not stopping:
            if socket.poll(50):
                if not begun:
                    _say(HEADER)
                begun, silent_s = True, math.inf
                line = receive(socket, table)
                if line:
                    _say(line)
            elif time.monotonic() > silent_s:
                silent_s = math.inf
                print(
                    f"nothing comes from {args.endpoint} so far; is a daemon there?",
                    file=sys.stderr,
                )
    if not begun:
        return 0
    print("\n".join(table.latencies()))
    if truth is not None:
        _say(table.final())
    return 0


def _draw(args: argparse.Namespace) -> int:
    from taxeld_hil.run.draw import draw

    draw(args.session, args.out, finding=args.moments)
    print(args.out)
    return 0


def _say(line: str) -> None:
    print(line, flush=True)


def _scenario(args: argparse.Namespace, layout: str | None = None) -> "Scenario":
    """The scenario that the arguments name, with their object, foam and layout, or another layout.

    Raises:
        SetupError: there is no such scenario or foam.
    """
    from taxeld_hil.scenario import scenario as scenarios

    layout = args.layout if layout is None else layout
    layouts = [layout] if isinstance(layout, str) else layout or ()
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
    _add_run(commands)
    _add_many(commands)
    _add_accept(commands)
    measurements.add(commands)
    _add_parts(commands)
    return parser


def _add_world(
    command: argparse.ArgumentParser, *, has_rows: bool = False, has_links: bool = False
) -> None:
    """What replaces parts of a scenario; `has_rows`: the command has a row a layout, `has_links`: a
    link for each of several."""
    about = "in place of the scenario's object: box, drill, mug, or a path"
    command.add_argument("--object", default="", metavar="BUNDLE", help=about)
    if has_rows:
        jobs.add_layouts(command, "the scenario's")
    else:
        about = "in place of the scenario's, as skin.layout"
        if has_links:
            about += "; each of several is of a link"
            command.add_argument("--layout", action="append", help=about)
        else:
            command.add_argument("--layout", default="", help=about)
    about = f"in place of the scenario's: {', '.join(FOAMS)}"
    foam = command.add_argument("--foam", default="", help=about)
    command_line.add_renamed(command, "--skin", foam)


def _add_run(commands: Commands) -> None:
    run = command(
        commands,
        "run",
        "Run a scenario with all its processes, and grade the daemon.",
        "taxeld-hil run demo",
        "taxeld-hil run everything --clock fake --foam poor",
        "taxeld-hil run demo --target can:can0 --poses tcp://127.0.0.1:9874 --truth 0.4 0.1 0",
        run=_run,
    )
    run.add_argument("scenario", metavar="SCENARIO", help="a shipped name (demo) or a TOML file")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--out", type=Path, help="directory for the session and its grade")
    about = "sim, can:can0, serial:/dev/ttyACM0 or slcan:/dev/ttyACM0"
    run.add_argument("--target", default="sim", help=about)
    run.add_argument("--poses", default="", help="on hardware: the robot's endpoint")
    run.add_argument(
        "--truth",
        type=float,
        nargs=3,
        metavar=("X", "Y", "THETA"),
        help="on hardware: where the object is in the robot's world [m, m, rad]",
    )
    run.add_argument(
        "--limit-s",
        type=float,
        default=600.0,
        help="on hardware: end the run after so many seconds",
    )
    run.add_argument("--clock", choices=("real", "fake"), default="real")
    about = "in place of the scenario's: slcan, native or can:INTERFACE"
    run.add_argument("--transport", default="", help=about)
    about = "the robot follows the daemon's advice (taxeld advise), in simulation"
    run.add_argument("--advised", action="store_true", help=about)
    run.add_argument("--view", action="store_true", help="show the session in the end")
    _add_world(run, has_links=True)


def _add_many(commands: Commands) -> None:
    soak = command(
        commands,
        "soak",
        "Run random faults for hours.",
        "taxeld-hil soak --hours 2",
        "taxeld-hil soak --real-minutes 10",
        run=_soak,
    )
    soak.add_argument("scenario", nargs="?", default="demo", metavar="SCENARIO")
    soak.add_argument("--seed", type=int, default=0)
    soak.add_argument("--no-faults", action="store_true", help="touches alone; on the fake clock")
    soak.add_argument("--frozen", action="store_true", help="the skin learns nothing; as above")
    long = soak.add_mutually_exclusive_group()
    long.add_argument("--hours", type=float, default=1.0, help="hours of scans, on the fake clock")
    long.add_argument("--real-minutes", type=float, help="minutes over the transport, in real time")
    soak.add_argument(
        "--out",
        type=Path,
        default=Path("soak.json"),
        help="the report, of another layout with its name at the end; a soak that was cut short "
        "goes on from it",
    )
    long.add_argument("--lap", type=int, metavar="N", help="instead: this lap alone")
    long.add_argument(
        "--table",
        type=Path,
        nargs="+",
        metavar="REPORT",
        help="instead: print these reports as a Markdown table",
    )
    _add_world(soak, has_rows=True)

    table = command(
        commands,
        "table",
        "Measure in which counter each fault shows, and how soon, as Markdown.",
        "taxeld-hil table --seeds 5",
        run=_table,
    )
    table.add_argument("--seeds", type=int, default=5)
    _add_world(table)


def _add_accept(commands: Commands) -> None:
    accept = command(
        commands,
        "accept",
        "Check a real skin before it is used; no object is needed.",
        "taxeld-hil accept can:can0 --layout skin.json",
        "taxeld-hil accept slcan:/dev/ttyACM0 --layout skin.json --press",
        run=_accept,
    )
    accept.add_argument(
        "target", metavar="TARGET", help="can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, …"
    )
    accept.add_argument("--layout", required=True, help="the layout of this skin, as skin.layout")
    accept.add_argument("--out", type=Path, help="directory for the report")
    accept.add_argument(
        "--seconds",
        type=float,
        default=15.0,
        help="seconds to listen while nothing touches the skin",
    )
    accept.add_argument("--press", action="store_true", help="then ask for a press on each module")
    accept.add_argument("--period-ms", type=int, default=50, help="milliseconds between scans")
    accept.add_argument(
        "--full-scale-counts",
        type=float,
        default=SkinConfig().full_scale_counts,
        help="as skin.full_scale_counts",
    )


def _add_parts(commands: Commands) -> None:
    """The commands for the harness's parts."""
    emulate = command(
        commands,
        "emulate",
        "Run the virtual skin and robot alone, for a daemon of yours.",
        "taxeld-hil emulate demo --link /tmp/skin --poses tcp://127.0.0.1:9874 --out emulated",
        run=_emulate,
    )
    emulate.add_argument("scenario", metavar="SCENARIO")
    emulate.add_argument("--seed", type=int, default=0)
    where = emulate.add_mutually_exclusive_group(required=True)
    where.add_argument(
        "--link", type=Path, help="path that will be a link to the virtual SLCAN adapter"
    )
    where.add_argument(
        "--can", metavar="INTERFACE", help="CAN interface of this machine, such as vcan0"
    )
    emulate.add_argument("--poses", required=True, help="endpoint for the robot's poses")
    emulate.add_argument("--out", type=Path, required=True, help="directory for the session")
    _add_world(emulate)

    watch = command(
        commands,
        "watch",
        "Print a line for each contact that a running daemon publishes.",
        "taxeld-hil watch --endpoint ipc:///run/taxeld/stream --bundle box",
        run=_watch,
    )
    watch.add_argument("--endpoint", required=True)
    watch.add_argument("--bundle", required=True)
    watch.add_argument("--layout", default="", help="default: what the bundle was built for")
    watch.add_argument(
        "--truth", type=Path, help="CSV of t,x,y,theta of the object; errors are printed"
    )

    draw = command(
        commands,
        "draw",
        "Draw the contacts of a recorded session.",
        "taxeld-hil draw session --out contacts.png",
        "taxeld-hil draw session --moments --out found.png",
        run=_draw,
    )
    draw.add_argument(
        "--moments",
        action="store_true",
        help="instead: four moments, from no touch to the object found",
    )
    draw.add_argument("session", type=Path)
    draw.add_argument("--out", type=Path, required=True)


if __name__ == "__main__":
    sys.exit(main())
