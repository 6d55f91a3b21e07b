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
    from taxeld_ros2.bridge import BridgeSettings

NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
FRAMES = ("world", "sensor")  # frames of poses, with a sensor pose configured and without


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    command_line.one_thread()
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    from taxeld.service import log
    from taxeld_ros2.bridge import Bridge

    settings = settings_of(args, load(args.config) if args.config else None)
    with log.written():
        log.set_level("info")
        bridge = Bridge(settings)
        try:
            bridge.run(command_line.stopping())
        except SetupError as error:  # at work: the daemon may have been exchanged
            print(error, file=sys.stderr)
            return FAILED
        finally:
            bridge.close()
    return 0


def settings_of(args: argparse.Namespace, config: Config | None) -> "BridgeSettings":
    """The arguments' settings, with the daemon's configuration where it is given.

    Raises:
        SetupError: they do not fit together.
    """
    from taxeld_ros2.bridge import BridgeSettings

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
    if (args.sensor_tf or args.sensor_topic) and not expected:
        raise SetupError(
            "sensor_pose.endpoint: is empty, so the daemon takes no poses of a robot; set it, as "
            "to tcp://127.0.0.1:9874"
        )
    return BridgeSettings(
        stream=stream,
        frame=args.frame or FRAMES[not expected],
        prefix=args.prefix.strip("/"),
        z_m=args.z_m,
        keys=args.keys,
        sensor_endpoint=expected,
        sensor_frames=args.sensor_tf,
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
    add, sensor = parser.add_argument, parser.add_mutually_exclusive_group()
    add("config", type=Path, nargs="?", metavar="CONFIG", help="the daemon's configuration")
    add("--stream", default="", metavar="ENDPOINT", help="in place of its publish.endpoints")
    about = "take the skin's pose from /tf: its frame in the world's"
    sensor.add_argument("--sensor-tf", nargs=2, metavar=("WORLD", "SKIN"), help=about)
    about = "take it from a topic of geometry_msgs/msg/PoseStamped"
    sensor.add_argument("--sensor-topic", default="", metavar="TOPIC", help=about)
    about = "where the daemon expects it (default: its sensor_pose.endpoint)"
    add("--sensor-endpoint", default="", metavar="ENDPOINT", help=about)
    about = "frame_id of the poses (default: world, or sensor where the daemon has no sensor pose)"
    add("--frame", default="", help=about)
    add("--prefix", default="taxeld", help="of the topics (default %(default)s)")
    add("--z-m", type=float, default=0.0, help="height of the poses (default %(default)s)")
    command_line.add_keys(parser)
    return parser


if __name__ == "__main__":
    sys.exit(main())
