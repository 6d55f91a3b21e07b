"""`taxeld-ros2`: the bridge to ROS 2."""

import argparse
import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from taxeld import command_line
from taxeld.command_line import FAILED
from taxeld.config.file import load
from taxeld.config.tables import Config
from taxeld.errors import SetupError

if TYPE_CHECKING:
    from taxeld_ros2.bridge import Settings

NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
FRAMES = ("world", "sensor")  # of poses, with a sensor pose configured and without


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    command_line.one_thread()
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    from taxeld.service import log, signals
    from taxeld_ros2.bridge import Bridge
    from taxeld_ros2.stream import VersionError

    settings = settings_of(args, load(args.config) if args.config else None)
    with log.written(), signals.Signals() as received:
        log.set_level("info")
        bridge = Bridge(settings)
        received.stop_by(bridge.stop)
        try:
            bridge.run()
        except VersionError as error:  # at work: the daemon may have been exchanged
            print(error, file=sys.stderr)
            return FAILED
        finally:
            bridge.close()
    return 0


def settings_of(args: argparse.Namespace, config: Config | None) -> "Settings":
    """What the arguments ask for, with the daemon's configuration where it is given.

    Raises:
        SetupError: they do not fit together.
    """
    from taxeld_ros2.bridge import Settings

    stream, expected = args.stream, args.sensor_endpoint
    if config is not None:
        stream = stream or next(iter(config.publish.endpoints), "")
        expected = expected or config.sensor_pose.endpoint
    if not stream:
        raise SetupError(
            "CONFIG or --stream: name the daemon's configuration, or where it publishes"
        )
    for option, name in (("--prefix", args.prefix), ("--sensor-topic", args.sensor_topic)):
        if name and not NAME.fullmatch(name):
            raise SetupError(f"{option}: {name!r:.80} is no name of a ROS 2 topic; use /arm/skin")
    if not math.isfinite(args.z_m):
        raise SetupError(f"--z-m: must be a height in metres, not {args.z_m}")
    wants = args.sensor_tf is not None or bool(args.sensor_topic)
    if wants and not expected:
        raise SetupError(
            "sensor_pose.endpoint: is empty, so the daemon takes no poses of a robot; set it, as "
            "to tcp://127.0.0.1:9874"
        )
    return Settings(
        stream=stream,
        frame=args.frame or FRAMES[not expected],
        prefix=args.prefix,
        z_m=args.z_m,
        domain=args.domain,
        keys=args.keys,
        markers=not args.no_markers,
        sensor_endpoint=expected,
        sensor_frames=None if args.sensor_tf is None else (args.sensor_tf[0], args.sensor_tf[1]),
        sensor_topic=args.sensor_topic,
    )


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-ros2",
        "Publish a daemon's estimates as ROS 2 topics, and hand the skin's pose from ROS 2 to it.",
        "taxeld-ros2 can0.toml",
        "taxeld-ros2 can0.toml --sensor-tf world skin_link",
        "taxeld-ros2 --stream tcp://127.0.0.1:9872 --frame base",
    )
    parser.set_defaults(command=_run)
    parser.add_argument(
        "config", type=Path, nargs="?", metavar="CONFIG", help="the daemon's configuration"
    )
    parser.add_argument(
        "--stream", default="", metavar="ENDPOINT", help="in place of its publish.endpoints"
    )
    sensor = parser.add_mutually_exclusive_group()
    sensor.add_argument(
        "--sensor-tf", nargs=2, metavar=("WORLD", "SKIN"),
        help="take the skin's pose from /tf: its frame in the world's",
    )  # fmt: skip
    sensor.add_argument(
        "--sensor-topic", default="", metavar="TOPIC",
        help="take it from a topic of geometry_msgs/msg/PoseStamped",
    )  # fmt: skip
    parser.add_argument(
        "--sensor-endpoint", default="", metavar="ENDPOINT",
        help="where the daemon expects it (default: its sensor_pose.endpoint)",
    )  # fmt: skip
    parser.add_argument(
        "--frame", default="", help="frame_id of what is published (default: world, or sensor "
        "where the daemon has no sensor pose)",
    )  # fmt: skip
    parser.add_argument("--prefix", default="taxeld", help="of the topics (default %(default)s)")
    parser.add_argument(
        "--z-m", type=float, default=0.0, help="height of the poses (default %(default)s)"
    )
    parser.add_argument("--no-markers", action="store_true", help="nothing for RViz")
    parser.add_argument("--domain", type=int, help="in place of ROS_DOMAIN_ID")
    parser.add_argument(
        "--keys", type=Path, metavar="DIR", help="with server.key and client.key_secret"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
