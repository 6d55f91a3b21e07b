"""A daemon's estimate and counters in aligned lines, in the manner of `chronyc tracking`."""

import math
from collections.abc import Iterator
from typing import Any

from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.pipeline.freshness import Why
from taxeld.proposals.samples import Degraded
from taxeld.skin.channels import mismatch
from taxeld.source import bus_faults
from taxeld.stream import values
from taxeld.stream.messages import name_of, object_of, reason_of

WIDTH = 14
STANDS = 0.99  # least probability at which nobody need think of the other hypotheses


def lines(answer: dict[str, Any]) -> Iterator[str]:
    """Lines of a subject each, from the answer to `status`; missing parts are left out."""
    rows = [*estimate_rows(answer["estimate"], answer.get("why", ""))]
    rows.append(("Samples", name_of(Degraded, answer["estimate"]["degraded"])))
    rows.append(("Age", f"{answer['estimate']['age_us'] / 1e3:.1f} ms since the scan"))
    if health := answer.get("health"):
        rows += _health_rows(health, answer.get("waits_for"))
        rows.append(("Modules", _modules(answer)))
        rows += _input_rows(health["inputs"], answer.get("sensor_pose", {}))
        rows += (("Not 0", line) for line in values.amiss(health))
    for name, text in rows:
        yield f"{name:{WIDTH}s}: {text}"


def estimate_rows(e: dict[str, Any], reason: str = "") -> Iterator[tuple[str, str]]:
    """Names and texts of an estimate's parts, from its map in the stream; `reason`: the daemon's
    own sentence why it is not valid, which has facts that the map lacks."""
    yield "Status", f"{name_of(Status, e['status'])}, {'valid' if e['valid'] else 'not valid'}"
    if not e["valid"]:
        yield "Not valid", reason or reason_of(e["why"])
    if not e["modes"]:
        return
    pose, cov = e["map"], e["cov"]
    yield "Pose", f"x {pose['x']:.4f} m, y {pose['y']:.4f} m, yaw {pose['theta']:.3f} rad"
    if named := object_of(e):
        yield "Object", named
    yield "Certainty", _certainty(e)
    x, y, yaw = (math.sqrt(max(cov[k][k], 0.0)) for k in range(3))
    yield "Uncertainty", f"x {x * 1e3:.1f} mm, y {y * 1e3:.1f} mm, yaw {yaw:.3f} rad (1 sd)"
    weights = ", ".join(f"{mode['weight']:.0%}" for mode in e["modes"])
    yield "Modes", f"{len(e['modes'])} ({weights})"
    yield "Contacts", f"{e['contacts']}, {'touching' if e['contact'] else 'not touching'} now"
    yield "Particles", f"{e['particles']}, {e['ess']:.0f} effective"
    yield "Proposal", name_of(ProposalKind, e["proposal"])


def _certainty(e: dict[str, Any]) -> str:
    """`p` and `radius_m`; the hypotheses where another than `stands` need be thought of."""
    line = f"p {e['p']:.1%}, radius {1e3 * e['radius_m']:.1f} mm"
    if e["hypotheses"]["stands"] < STANDS:
        line += "; " + ", ".join(f"{name} {p:.0%}" for name, p in e["hypotheses"].items())
    return line + ("; touch another side" if e["status"] == Status.AMBIGUOUS else "")


def _health_rows(health: dict[str, Any], waits_for: str | None) -> Iterator[tuple[str, str]]:
    """`waits_for` is None in an answer before the daemon's first health."""
    scans, up_s = health["source"]["scans"], health["uptime_s"]
    yield "Scans", f"{scans}, {scans / max(up_s, 1e-9):.1f} a second over {up_s:.0f} s"
    granted = health["realtime"]
    fifo = f"FIFO {granted['fifo']}" if granted["fifo"] else "not a FIFO thread"
    yield "Real time", f"{fifo}, memory {'locked' if granted['locked'] else 'not locked'}"
    yield "Device", f"waiting, {waits_for}" if waits_for else "works"
    if told := bus_faults.counted(health["source"].get("bus", {})):
        yield "Bus", told
    days = health["calibration"]["age_s"] / 86_400.0
    none = "none; full scale and mount are as configured"
    yield "Calibration", none if days < 0.0 else f"{days:.1f} days old"
    for name, link in health.get("links", {}).items():
        left_out = "" if link["why"] == Why.VALID else f"is left out, {reason_of(link['why'])}"
        yield f"Link {name}", f"{left_out or 'works'}, {len(link['dead_taxels'])} dead taxels"
    dead = health["dead_taxels"]
    yield "Dead taxels", f"{len(dead)} ({', '.join(map(str, dead))})" if dead else "none"
    p50, p99, top = (health["lat_us"]["total"][key] / 1e3 for key in ("p50", "p99", "max"))
    yield "Total time", f"median {p50:.2f} ms, 99 % {p99:.2f} ms, max {top:.2f} ms"


def _input_rows(inputs: dict[str, Any], sensor_pose: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """`sensor_pose` is empty in an answer before the daemon's first health."""
    endpoint = sensor_pose.get("endpoint")
    if endpoint == "":
        yield "Sensor poses", "sensor_pose.endpoint is empty: the sensor stands still"
        return
    yield "Sensor poses", f"{inputs['poses']} used{f', from {endpoint}' if endpoint else ''}"
    if inputs["poses_age_s"] >= 0.0:
        rate, age_s = inputs["poses_rate_hz"], inputs["poses_age_s"]
        offset_s = inputs["poses_offset_s"]
        side = "ahead of" if offset_s < 0.0 else "behind"
        late = f"their time {abs(offset_s):.3g} s {side} this clock"
        yield "Pose timing", f"{rate:.4g} a second, the last {age_s:.3g} s ago, {late}"
    if sensor_pose.get("fault"):
        yield "Pose fault", sensor_pose["fault"]


def _modules(answer: dict[str, Any]) -> str:
    modules, missing = answer["health"]["modules"], answer["health"]["missing_modules"]
    if not answer["health"]["skin"]["scans"]:
        return "no scan yet"
    match = answer["estimate"]["why"] != Why.MODULES_MISSING
    wrong = mismatch(missing, modules["layout"], modules["foreign"], match)
    return wrong or f"{modules['layout']}, as in the layout"
