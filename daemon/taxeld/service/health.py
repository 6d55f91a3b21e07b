"""What a running daemon says of itself once a second, `/taxeld/health`: from all its parts.

Each value has a cure in docs/stream.md, or a user in this repository.
"""

from typing import TYPE_CHECKING, Any

from taxeld.pipeline.poses import AGE_S
from taxeld.skin.calibration import DAY_S
from taxeld.stream import messages

if TYPE_CHECKING:
    from taxeld.service.loop import Daemon


def of(daemon: "Daemon", seq: int, now_s: float, t: float) -> dict[str, Any]:
    """The message; `seq`: of the last estimate, `now_s` is monotonic, `t` Unix time."""
    pipeline, source, report = daemon.pipeline, daemon.inputs.source, daemon.link.report
    poses = daemon.inputs.pose_figures(daemon.link, t)
    written = daemon.recorder.counters if daemon.recorder else None
    calibration = pipeline.stages[0].calibration
    parts = {
        "uptime_s": now_s - daemon.start_s,
        "loop": daemon.counters,
        "lat_us": {"total": daemon.publisher.latencies.percentiles()},
        "realtime": daemon.realtime,
        "source": {
            **source.wire.stats(),
            **({"refused": report.array.malformed} if source.comes_by_door else {}),
            "lost": source.counters.lost,
            "unopened": source.counters.unopened,
            "unsent": source.counters.unsent,
            "waiting": bool(source.waits_for),
            "bus": source.bus.counts,
            "firmware": dict(source.firmware),
        },
        "inputs": {
            **pipeline.stages[0].counts(),
            "scans_stale": pipeline.freshness.is_silent(now_s),
            "poses_stale": t - pipeline.poses.latest_t > AGE_S,
            "poses_malformed": report.robot.malformed,
            "poses_connected": poses.connected,
            "poses_rate_hz": poses.rate_hz,
            "poses_age_s": poses.age_s,
            "poses_offset_s": poses.offset_s,
        },
        "calibration": {
            "used": calibration is not None,
            "age_s": 0.0 if calibration is None else calibration.age_days(t) * DAY_S,
        },
        "door": {
            "starts": daemon.door.starts,
            "unsent": daemon.link.unsent,
            "failed": daemon.link.failed,
            "keys_refused": report.keys_refused,
            "unbound": report.unbound,
        },
        "recording": {
            "dropped": written.dropped if written else 0,
            "failed": written is not None and written.failed,
        },
        **pipeline.health(),
    }
    if len(daemon.layouts) > 1:
        names = enumerate(daemon.config.names)
        parts["links"] = {name: _link(daemon, k, now_s, t) for k, name in names}
    return messages.health(seq, t, parts)


def _link(daemon: "Daemon", number: int, now_s: float, t: float) -> dict[str, Any]:
    """What one of several links adds: why its scans are of no use, its source, and its skin."""
    stage = daemon.pipeline.stages[number]
    source = next(bus.source for bus in daemon.inputs.buses if number in bus.links)
    return {
        "why": int(daemon.pipeline.freshness.of_links(now_s)[number]),
        "waiting": bool(source.waits_for),
        "lost": source.counters.lost,
        "inputs": {**stage.counts(), "poses_stale": t - stage.poses.latest_t > AGE_S},
        **stage.health(),
    }
