"""`taxeld-hil`: the harness's commands."""

import argparse
import signal
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import zmq

from taxeld import bundle, layout, messages, session
from taxeld.config import SkinConfig
from taxeld.errors import SetupError
from taxeld_hil import scenario as scenarios

GOOD_MM = 10.0  # the error that a scenario may end with


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    args = _parser().parse_args(argv)
    try:
        return int(args.command(args))
    except SetupError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


def _run(args: argparse.Namespace) -> int:
    from taxeld_hil.run import run

    scenario = scenarios.load(args.scenario)
    out = args.out or Path(tempfile.mkdtemp(prefix=f"taxeld-{Path(args.scenario).stem}-"))
    print(f"scenario {args.scenario}, seed {args.seed}: session in {out}", flush=True)
    result = run(args.scenario, scenario, args.seed, out)
    good = result.error_mm < GOOD_MM
    verdict = "found" if good else f"not found: the error is not under {GOOD_MM:g} mm"
    print(f"object {verdict}", flush=True)
    return 0 if good else 1


def _emulate(args: argparse.Namespace) -> int:
    from taxeld_hil.emulate import Emulation

    emulation = Emulation(scenarios.load(args.scenario), args.seed)
    if emulation.run(args.poses, args.can or args.link, args.out):
        return 0
    print("no host started the skin, or it stopped it before the end", file=sys.stderr)
    return 1


def _accept(args: argparse.Namespace) -> int:
    from taxeld_hil.accept import SECONDS_MAX, SECONDS_MIN, run

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
    return 0 if report.passed else 1


def _watch(args: argparse.Namespace) -> int:
    from taxeld_hil.watch import HEADER, Watch, receive

    skin = layout.load(args.layout)
    scene = bundle.load(args.bundle, skin, SkinConfig().full_scale_depth_m).model.scene
    truth = np.array(session.read_poses(args.truth)[-1][1:]) if args.truth else None
    watch = Watch(scene, truth)
    stopping: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _: stopping.append(got))
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.connect(args.endpoint)
        for topic in (messages.ESTIMATE, messages.TAXELS):
            socket.setsockopt(zmq.SUBSCRIBE, topic)
        print(HEADER, flush=True)
        while not stopping:
            if socket.poll(50):
                line = receive(socket, watch)
                if line:
                    print(line, flush=True)
    print("\n".join(watch.latencies()))
    print(f"final symmetry-aware ADD {watch.error_mm():.1f} mm", flush=True)
    if args.error_to:
        args.error_to.write_text(f"{watch.error_mm()}\n", encoding="ascii")
    return 0


def _draw(args: argparse.Namespace) -> int:
    from taxeld_hil.draw import draw

    draw(args.session, args.out)
    print(args.out)
    return 0


def _physics(args: argparse.Namespace) -> int:
    from taxeld_hil.physics_experiment import Plan, experiment

    plan = Plan.quick if args.quick else Plan
    given = {
        "contacts": args.contacts,
        "seeds": args.seeds,
        "seed": args.seed,
        "noise_sigma": args.noise_sigma,
    }
    objects = tuple(args.object or ("box", "mug"))
    chosen = plan(objects=objects, **{k: v for k, v in given.items() if v is not None})
    for path in experiment(chosen, args.out, lambda line: print(line, file=sys.stderr, flush=True)):
        print(path)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="taxeld-hil", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="a scenario with all its processes")
    run.add_argument("scenario", metavar="SCENARIO", help="a shipped name (demo) or a TOML file")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument("--out", type=Path, help="directory for the session")
    run.set_defaults(command=_run)

    emulate = commands.add_parser("emulate", help="the virtual skin and robot alone")
    emulate.add_argument("scenario", metavar="SCENARIO")
    emulate.add_argument("--seed", type=int, default=0)
    where = emulate.add_mutually_exclusive_group(required=True)
    where.add_argument("--link", type=Path, help="that will name an SLCAN adapter")
    where.add_argument("--can", metavar="INTERFACE", help="of this machine's kernel, as vcan0")
    emulate.add_argument("--poses", required=True, help="endpoint for the robot's poses")
    emulate.add_argument("--out", type=Path, required=True, help="directory for the session")
    emulate.set_defaults(command=_emulate)

    watch = commands.add_parser("watch", help="a subscriber's table of contacts")
    watch.add_argument("--endpoint", required=True)
    watch.add_argument("--bundle", required=True)
    watch.add_argument("--layout", default=SkinConfig().layout)
    watch.add_argument("--truth", type=Path, help="t,x,y,theta of the object, for errors")
    watch.add_argument("--error-to", type=Path, help="file for the final error in mm")
    watch.set_defaults(command=_watch)

    accept = commands.add_parser("accept", help="whether a skin that is there is fit for use")
    accept.add_argument(
        "target", metavar="TARGET", help="can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, …"
    )
    accept.add_argument("--layout", required=True, help="of this skin, as skin.layout")
    accept.add_argument("--out", type=Path, help="directory for the report")
    accept.add_argument("--seconds", type=float, default=15.0, help="to listen, untouched")
    accept.add_argument("--press", action="store_true", help="then ask for a press on each module")
    accept.add_argument("--period-ms", type=int, default=50, help="between scans, to ask for")
    accept.add_argument(
        "--full-scale-counts", type=float, default=SkinConfig().full_scale_counts,
        help="as skin.full_scale_counts",
    )  # fmt: skip
    accept.set_defaults(command=_accept)

    draw = commands.add_parser("draw", help="a session's contacts as a picture")
    draw.add_argument("session", type=Path)
    draw.add_argument("--out", type=Path, required=True)
    draw.set_defaults(command=_draw)

    physics = commands.add_parser("physics", help="the estimator's model beside a soft skin's")
    physics.add_argument("--object", action="append", metavar="BUNDLE", help="default: box and mug")
    physics.add_argument("--contacts", type=int, metavar="N", help="an object, to compare readings")
    physics.add_argument("--seeds", type=int, metavar="N", help="runs of the demo's path a kind")
    physics.add_argument("--seed", type=int, help="of the contacts")
    physics.add_argument("--noise-sigma", type=float, metavar="SD", help="default: the daemon's")
    physics.add_argument("--quick", action="store_true", help="a smoke run of seconds")
    physics.add_argument("--out", type=Path, required=True, help="directory for JSON and PNG")
    physics.set_defaults(command=_physics)
    return parser


if __name__ == "__main__":
    sys.exit(main())
