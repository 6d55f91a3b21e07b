"""What a running daemon says of itself once a second, `/taxeld/health`: from all its parts.

The table in `stream/values.md` chooses what is published of all that is counted.
"""

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

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
        "loop": asdict(daemon.counters),
        "lat_us": {"total": daemon.publisher.latencies.percentiles()},
        "realtime": asdict(daemon.realtime),
        "source": {
            **source.wire.stats(),
            **({"malformed": report.array.malformed} if source.comes_by_door else {}),
            **asdict(source.counters),
            "bus": {fault: n for fault, n in source.bus.counts.items() if n},
        },
        "inputs": {
            **pipeline.stages[0].counts(),
            **{f"poses_{name}": value for name, value in asdict(poses).items()},
            "poses_malformed": report.robot.malformed,
        },
        "calibration": {"age_s": calibration.age_days(t) * DAY_S if calibration else -1.0},
        "door": {
            "starts": daemon.door.starts,
            "unsent": daemon.link.unsent,
            "failed": daemon.link.failed,
            "keys_refused": report.keys_refused,
            "unbound": report.unbound,
        },
        "recording": {
            "dropped": written.dropped if written else 0,
            "failed": bool(written and written.failed),
        },
        **pipeline.health(),
    }
    if len(daemon.layouts) > 1:
        names = enumerate(daemon.config.names)
        parts["links"] = {name: _link(daemon, k, now_s) for k, name in names}
    return messages.health(seq, t, parts)


def _link(daemon: "Daemon", number: int, now_s: float) -> dict[str, Any]:
    """What one of several links adds: why its scans are of no use, its source, and its skin."""
    stage = daemon.pipeline.stages[number]
    source = next(bus.source for bus in daemon.inputs.buses if number in bus.links)
    return {
        "why": int(daemon.pipeline.freshness.of_links(now_s)[number]),
        "source": asdict(source.counters),
        "inputs": stage.counts(),
        **stage.health(),
    }
