"""`taxeld-ros2`: the bridge to ROS 2."""

import argparse
import contextlib
import re
import sys
from pathlib import Path

from taxeld import command_line
from taxeld.config.file import load
from taxeld.errors import SetupError

NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)


def main(argv: list[str] | None = None) -> int:
    """0 fine, 1 failed at work, 2 wrong arguments or configuration."""
    return command_line.main(_parser(), argv)


def _run(args: argparse.Namespace) -> int:
    from taxeld.commands import running
    from taxeld.service import log
    from taxeld_ros2.bridge import Bridge

    stream = running.endpoint_of(args.daemon, running.PUBLISH)
    robot = "" if stream == args.daemon else load(Path(args.daemon)).sensor_pose.endpoint
    if args.sensor_topic and not robot:
        fault = "is not in CONFIG, so the daemon takes no poses; set it, as to tcp://127.0.0.1:9874"
        raise SetupError(f"sensor_pose.endpoint: {fault}")
    for option, name in (("--prefix", args.prefix), ("--sensor-topic", args.sensor_topic)):
        if name and not NAME.fullmatch(name):
            raise SetupError(f"{option}: {name!r:.80} is no name of a ROS 2 topic; use /arm/skin")
    frame = args.frame or ("world" if robot else "sensor")
    with log.written():
        log.set_level("info")
        with contextlib.closing(Bridge(stream, args.prefix.strip("/"), frame)) as bridge:
            if args.sensor_topic:
                bridge.listen(args.sensor_topic, robot)
            bridge.run(command_line.stopping())
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = command_line.parser(
        "taxeld-ros2",
        "Publish a daemon's estimates as ROS 2 topics, and hand the skin's pose from ROS 2 to it.",
        "taxeld-ros2 can0.toml --sensor-topic /arm/skin",
        "taxeld-ros2 tcp://127.0.0.1:9872 --frame base",
    )
    parser.set_defaults(command=_run)
    add = parser.add_argument
    add("daemon", metavar="CONFIG|ENDPOINT", help="of the daemon, or where it publishes")
    about = "take the skin's pose from a topic of geometry_msgs/msg/PoseStamped"
    add("--sensor-topic", default="", metavar="TOPIC", help=about)
    about = "frame_id of the poses (default: world, or sensor where the daemon has no sensor pose)"
    add("--frame", default="", help=about)
    add("--prefix", default="taxeld", help="of the topics (default %(default)s)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
