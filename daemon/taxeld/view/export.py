"""A session as an MCAP file of ROS 2 messages, for Foxglove, PlotJuggler and `ros2 bag`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mcap_ros2.writer import Writer

from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.view import ros_messages as ros
from taxeld.view.recorded import Recording
from taxeld.view.ros_types import definition
from taxeld.view.stage import Message, Stage

TYPES = {
    "/tf": "tf2_msgs/TFMessage",
    "/taxeld/pose": "geometry_msgs/PoseWithCovarianceStamped",
    "/taxeld/modes": "geometry_msgs/PoseArray",
    "/taxeld/particles": "geometry_msgs/PoseArray",
    "/taxeld/taxels": "sensor_msgs/PointCloud2",
    "/taxeld/status": "diagnostic_msgs/DiagnosticArray",
    "/taxeld/truth": "geometry_msgs/PoseStamped",
}


def export(directory: Path, out: Path, config: Path | None = None) -> dict[str, int]:
    """Replay a session and write what it led to; → the number of messages by topic.

    The file is whole or not there: it is written beside `out`, which it then replaces.

    Raises:
        SetupError: the session cannot be used or holds nothing to export, or `out` cannot be
            written.
    """
    recording = Recording(directory, config)
    beside = out.with_name(out.name + ".new")
    try:
        with beside.open("wb") as file:
            written = _write(recording, Writer(file))
        if not written:
            raise SetupError(f"{directory}: holds no scan, so there is nothing to export")
        beside.replace(out)
    except OSError as error:
        raise SetupError(f"--mcap: cannot write {out} ({error.strerror})") from None
    finally:
        beside.unlink(missing_ok=True)
    return written


def _write(recording: Recording, writer: Writer) -> dict[str, int]:
    schemas = {
        name: writer.register_msgdef(name.replace("/", "/msg/"), definition(name))
        for name in TYPES.values()
    }
    written: dict[str, int] = {}
    for message in recording:
        for topic, made in _made(recording.stage, message):
            if topic == "/taxeld/truth" and topic in written:
                continue
            t_ns = round(message[1]["t"] * 1e9)
            number = written[topic] = written.get(topic, 0) + 1
            writer.write_message(topic, schemas[TYPES[topic]], made, t_ns, t_ns, number)
    writer.finish()
    return written


def _made(stage: Stage, message: Message) -> Iterator[tuple[str, dict[str, Any]]]:
    """A message of the streams as those of ROS 2, with their topics."""
    topic, m = message
    if topic == messages.ESTIMATE:
        yield "/taxeld/status", ros.diagnostics(m["t"], "taxeld", m, hardware=stage.layout)
        if m["valid"]:
            yield "/taxeld/pose", ros.pose_with_covariance(m)
            yield "/taxeld/modes", ros.pose_array(m["t"], m["modes"])
    elif topic == messages.TAXELS:
        if m["placed"]:
            yield "/tf", ros.transform(m)
        yield "/taxeld/taxels", ros.point_cloud(m, stage.position_m)
        if stage.truth is not None:
            yield "/taxeld/truth", ros.pose_stamped(m["t"], stage.truth)
    elif topic == messages.PARTICLES:
        poses = [dict(zip(("x", "y", "theta"), p, strict=True)) for p in m["xytheta"]]
        yield "/taxeld/particles", ros.pose_array(m["t"], poses)
