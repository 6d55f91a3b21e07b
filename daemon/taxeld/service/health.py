"""What a running daemon says of itself once a second, `/taxeld/health`: from all its parts."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from taxeld.pipeline.calibrated import told
from taxeld.pipeline.pose_watch import PoseFigures
from taxeld.source.recorder import RecordCounters
from taxeld.stream import messages
from taxeld.stream.answers import ControlCounters
from taxeld.stream.pose_input import PoseCounters

if TYPE_CHECKING:
    from taxeld.service.loop import Daemon


def of(daemon: "Daemon", seq: int, now_s: float, t: float) -> dict[str, Any]:
    """The message; `seq`: of the last estimate, `now_s` is monotonic, `t` Unix time."""
    pipeline, source = daemon.pipeline, daemon.source
    robot, recorder = daemon.pose_input, daemon.recorder
    poses = robot.counters if robot else PoseCounters()
    figures = robot.figures(t) if robot else PoseFigures()
    control = daemon.control.counters if daemon.control else ControlCounters()
    subscribers = daemon.publisher.counters
    parts = {
        "uptime_s": now_s - daemon.start_s,
        "loop": daemon.counters,
        "over_budget": daemon.over_budget,
        "degraded": pipeline.ladder.counters,
        "realtime": daemon.realtime,
        "source": {
            **source.wire.stats(),
            **asdict(source.counters),
            "waiting": bool(source.waits_for),
        },
        "skin_state": daemon.kept.counters,
        "calibration": told(pipeline.calibration, pipeline.estimator.calibration, t),
        "inputs": {
            **pipeline.input_counts(),
            "poses_malformed": poses.malformed,
            "poses_oversized": poses.oversized,
            "scans_stale": pipeline.freshness.is_silent(now_s),
            "poses_stale": t - pipeline.poses.latest_t > pipeline.poses.max_age_s,
            **{f"poses_{name}": value for name, value in asdict(figures).items()},
        },
        "control": control,
        "recording": recorder.counters if recorder else RecordCounters(),
        "subscribers": subscribers,
        "hoarders": subscribers.oversized + control.oversized,
        "keys_refused": 0,  # a relay, where keys are taken, puts its own count there
        "lat_us": daemon.latencies.percentiles(),
        **pipeline.health(),
    }
    return messages.health(seq, t, parts)
