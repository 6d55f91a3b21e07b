"""`taxeld-train`: the offline commands."""

import argparse
import sys
from pathlib import Path

from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

from taxeld import layout
from taxeld.errors import SetupError
from taxeld_training.build import VARIANTS, BuildConfig, build
from taxeld_training.variants import trained_with

DEFAULT_SKIN = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"


def main(argv: list[str] | None = None) -> int:
    args = _parser().parse_args(argv)
    try:
        return int(args.command(args))
    except SetupError as error:
        print(f"taxeld-train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


def _build(args: argparse.Namespace) -> int:
    config = BuildConfig(
        height_m=args.height_m,
        variants=tuple(trained_with(v, args.updates, args.contacts, args.seed) for v in VARIANTS),
        bank=args.bank,
        seed=args.seed,
    )
    columns = (SpinnerColumn(), *Progress.get_default_columns(), TimeElapsedColumn())
    with Progress(*columns) as bar:
        tasks: dict[str, int] = {}

        def progress(stage: str, share: float) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=1.0)
            bar.update(tasks[stage], completed=share)  # type: ignore[arg-type]

        out = build(args.object, layout.load(args.skin), config, args.out, progress)
    print(out)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="taxeld-train", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    one = commands.add_parser("build", help="an object and a skin → a scene bundle")
    one.add_argument("object", metavar="OBJECT", help="a YCB id (025_mug) or a mesh file")
    one.add_argument("--skin", default=DEFAULT_SKIN, metavar="LAYOUT")
    one.add_argument(
        "--height-m", type=float, default=0.04, metavar="H",
        help="sensor frame's origin above the object's lowest point (default 0.04)",
    )  # fmt: skip
    one.add_argument("--out", type=Path, required=True, metavar="BUNDLE")
    one.add_argument("--updates", type=int, default=8_000, help="of the weights, of each model")
    one.add_argument("--contacts", type=int, default=300_000, help="simulated, to train on")
    one.add_argument(
        "--bank", type=int, default=1_000_000, help="contacts of the exact posterior measured to"
    )
    one.add_argument("--seed", type=int, default=0)
    one.set_defaults(command=_build)
    return parser


if __name__ == "__main__":
    sys.exit(main())
