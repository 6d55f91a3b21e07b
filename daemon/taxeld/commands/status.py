"""What a daemon believes and counts, in aligned lines, in the manner of `chronyc tracking`."""

import math
from collections.abc import Iterator
from typing import Any

from taxeld.estimator.calibration_check import Suspect
from taxeld.estimator.estimate import ProposalKind, Status

WIDTH = 14


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """A line a subject of the answer to `status`; parts that it lacks are left out."""
    for name, text in _rows(answer.get("estimate", {}), answer):
        yield f"{name:{WIDTH}s}: {text}"


def _rows(e: dict[str, Any], answer: dict[str, Any]) -> Iterator[tuple[str, str]]:
    yield "Status", f"{_name(Status, e['status'])}, {'valid' if e['valid'] else 'not valid'}"
    pose, cov = e["map"], e["cov"]
    yield "Pose", f"x {pose['x']:.4f} m, y {pose['y']:.4f} m, yaw {pose['theta']:.3f} rad"
    x, y, yaw = (math.sqrt(max(cov[k][k], 0.0)) for k in range(3))
    yield "Uncertainty", f"x {x * 1e3:.1f} mm, y {y * 1e3:.1f} mm, yaw {yaw:.3f} rad (1 sd)"
    weights = ", ".join(f"{mode['weight']:.0%}" for mode in e["modes"])
    alone = e["status"] == Status.AMBIGUOUS and len(e["modes"]) == 1
    why = "; not narrow, or not confirmed by a touch since: touch another side" if alone else ""
    yield "Modes", f"{len(e['modes'])} ({weights}){why}"
    yield "Contacts", f"{e['contacts']}, {'touching' if e['contact'] else 'not touching'} now"
    yield "Age", f"{e['age_us'] / 1e3:.1f} ms since the scan"
    yield "Particles", f"{e['particles']}, {e['ess']:.0f} effective"
    yield "Proposal", _name(ProposalKind, e["proposal"])
    if answer.get("health"):
        yield from _health_rows(answer["health"], answer.get("waits_for"))


def _health_rows(health: dict[str, Any], waits_for: str | None) -> Iterator[tuple[str, str]]:
    loop, source, inputs = health["loop"], health["source"], health["inputs"]
    up_s = max(health["uptime_s"], 1e-9)
    rates = f"{loop['ticks'] / up_s:.1f} ticks/s, {loop['scans'] / up_s:.1f} scans/s"
    yield "Rate", f"{rates}, over {up_s:.0f} s"
    own = f"{loop['own_overruns']} of the loop's own work"
    yield "Ticks", f"{loop['ticks']}, {loop['overruns']} overruns, {own}"
    over = ", ".join(f"{n} {stage}" for stage, n in health["over_budget"].items() if n) or "none"
    yield "Over budget", over
    yield (
        "Samples",
        ", ".join(f"{n} {step}" for step, n in health["degraded"].items() if n) or "none",
    )
    granted = health["realtime"]
    fifo = f"FIFO {granted['fifo']}" if granted["fifo"] else "not a FIFO thread"
    yield "Real time", f"{fifo}, memory {'locked' if granted['locked'] else 'not locked'}"
    yield "Scans", f"{loop['scans']}, {source['incomplete']} incomplete"
    dropped = ", ".join(f"{n} {cause}" for cause, n in source["dropped"].items() if n) or "none"
    yield "Frames", f"{source['frames']}, dropped {dropped}"
    yield "Device", _device(source, waits_for)
    used = health.get("calibration")
    if used:
        yield "Calibration", _calibration(used)
    stale = [name for name in ("scans", "poses") if inputs[f"{name}_stale"]]
    yield "Stale inputs", ", ".join(stale) or "none"
    poses = f"{inputs['poses_malformed']} malformed, {inputs['poses_rejected']} rejected"
    yield "Sensor poses", f"{poses}, {inputs['scans_without_pose']} scans without"
    dead = health["dead_taxels"]
    yield "Dead taxels", f"{len(dead)} ({', '.join(map(str, dead))})" if dead else "none"
    for stage, us in health["lat_us"].items():
        p50, p99, top = (us[key] / 1e3 for key in ("p50", "p99", "max"))
        figures = f"median {p50:.2f} ms, 99 % {p99:.2f} ms, max {top:.2f} ms"
        yield f"{stage.capitalize()} time", figures


def _calibration(used: dict[str, Any]) -> str:
    days = f"{used['age_s'] / 86_400.0:.1f} days old"
    line = days if used["used"] else "none; full scale and mount are as configured"
    return line + _doubt(used)


def _doubt(used: dict[str, Any]) -> str:
    """What touches say against a calibration, and the cure."""
    try:
        suspect = Suspect(used["suspect"])
    except ValueError:
        return "; in doubt (by a newer daemon)"
    if suspect is Suspect.NONE:
        return ""
    yaw = math.degrees(used["mount_yaw_rad"])
    off = {
        Suspect.SCALE: f"readings are {used['scale']:.2f} times what they should be",
        Suspect.MOUNT: f"the mount seems {1e3 * used['mount_x_m']:+.1f} mm, "
        f"{1e3 * used['mount_y_m']:+.1f} mm, {yaw:+.1f}° off",
        Suspect.MODULES: "modules seem to have changed places",
    }[suspect]
    return f"; IN DOUBT: {off}; taxeld calibrate"


def _device(source: dict[str, Any], waits_for: str | None) -> str:
    """`waits_for`: None where it is not known, as a relay's answers come without."""
    in_vain = f"{source.get('unopened', 0)} attempts to open it failed"
    if waits_for or source.get("waiting"):
        return f"waiting, {waits_for or 'the log of the daemon says for what'}; {in_vain}"
    return f"lost {source['lost']} times, {in_vain}, {source['unsent']} requests unsent"


def _name(kind: type[Status] | type[ProposalKind], value: int) -> str:
    try:
        return kind(value).name.lower()
    except ValueError:
        return f"{value} (of a newer daemon)"
