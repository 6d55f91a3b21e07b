"""A session as an MCAP file of ROS 2 messages, for Foxglove, PlotJuggler and `ros2 bag`."""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from mcap_ros2.writer import Writer

from taxeld.errors import SetupError
from taxeld.stream import messages
from taxeld.view import ros
from taxeld.view.stage import Stage, recorded
from taxeld.view.streams import Message

TYPES = {
    "/tf": "tf2_msgs/TFMessage",
    "/taxeld/pose": "geometry_msgs/PoseWithCovarianceStamped",
    "/taxeld/modes": "geometry_msgs/PoseArray",
    "/taxeld/particles": "geometry_msgs/PoseArray",
    "/taxeld/taxels": "sensor_msgs/PointCloud2",
    "/taxeld/status": "diagnostic_msgs/DiagnosticArray",
    "/taxeld/truth": "geometry_msgs/PoseStamped",
}


def export(directory: Path, out: Path, config: Path | None = None) -> Counter[str]:
    """Replay a session and write its messages; → the number of messages by topic.

    The file is whole or not there: it is written beside `out`, which it then replaces.

    Raises:
        SetupError: the session cannot be used or holds nothing to export, or `out` cannot be
            written.
    """
    stage, heard = recorded(directory, config)
    beside = out.with_name(out.name + ".new")
    try:
        with beside.open("wb") as file:
            written = _write(Writer(file), stage, heard)
        if not written:
            raise SetupError(f"{directory}: holds no scan, so there is nothing to export")
        beside.replace(out)
    except OSError as error:
        raise SetupError(f"--mcap: cannot write {out} ({error.strerror})") from None
    finally:
        beside.unlink(missing_ok=True)
    return written


def _write(writer: Writer, stage: Stage, heard: Iterable[Message]) -> Counter[str]:
    schemas = {
        name: writer.register_msgdef(name.replace("/", "/msg/"), ros.definition(name))
        for name in TYPES.values()
    }
    written: Counter[str] = Counter()
    for message in heard:
        for topic, made in _made(stage, message):
            if topic != "/taxeld/truth" or not written[topic]:
                t_ns = round(message[1]["t"] * 1e9)
                written[topic] += 1
                schema = schemas[TYPES[topic]]
                writer.write_message(topic, schema, made, t_ns, t_ns, written[topic])
    writer.finish()
    return written


def _made(stage: Stage, message: Message) -> Iterator[tuple[str, dict[str, Any]]]:
    topic, m = message
    if topic == messages.ESTIMATE:
        yield "/taxeld/status", ros.diagnostics(m["t"], "taxeld", m, hardware=stage.layout)
        if ros.is_usable(m):
            yield "/taxeld/pose", ros.pose_with_covariance(m)
        if m["valid"]:
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
