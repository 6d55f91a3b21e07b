"""What a running daemon says of itself once a second, `/taxeld/health`: from all its parts."""

from dataclasses import fields
from typing import TYPE_CHECKING, Any

from taxeld.pipeline.calibrated import told
from taxeld.source.recorder import RecordCounters
from taxeld.stream import messages

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from taxeld.service.loop import Daemon


def of(daemon: "Daemon", seq: int, now_s: float, t: float) -> dict[str, Any]:
    """The message; `seq`: of the last estimate, `now_s` is monotonic, `t` Unix time."""
    pipeline, source = daemon.pipeline, daemon.source
    recorder, report = daemon.recorder, daemon.link.report
    parts = {
        "uptime_s": now_s - daemon.start_s,
        "loop": daemon.counters,
        "degraded": pipeline.ladder.counters,
        "realtime": daemon.realtime,
        "source": {
            **source.wire.stats(),
            **_counts(source.counters),
            "waiting": bool(source.waits_for),
        },
        "skin_state": daemon.kept.counters,
        "calibration": told(pipeline.calibration, pipeline.estimator.calibration, t),
        "inputs": {
            **pipeline.input_counts(),
            "poses_malformed": report.robot.malformed,
            "poses_oversized": report.robot.oversized,
            "poses_lost": report.poses_lost,
            "scans_stale": pipeline.freshness.is_silent(now_s),
            "poses_stale": t - pipeline.poses.latest_t > pipeline.poses.max_age_s,
            **{f"poses_{name}": value for name, value in _counts(daemon.pose_figures(t)).items()},
        },
        "door": {
            "starts": daemon.door.starts,
            "confined": report.confined,
            "peers": report.peers,
            **_counts(daemon.link.counters),
            "crowded_out": report.crowded_out,
            "reconnected": report.robot.reconnected,
        },
        "control": report.control,
        "recording": recorder.counters if recorder else RecordCounters(),
        "subscribers": report.subscribers,
        "hoarders": report.hoarders,
        "keys_refused": report.keys_refused,
        "lat_us": daemon.latencies.percentiles(),
        **pipeline.health(),
    }
    return messages.health(seq, t, parts)


def _counts(counters: "DataclassInstance") -> dict[str, Any]:
    """As `dataclasses.asdict`, which copies each value: once a second that takes longer."""
    return {each.name: getattr(counters, each.name) for each in fields(counters)}
