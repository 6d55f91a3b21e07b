"""Acceptance: the rate of the scans, and what the link damaged."""

from dataclasses import asdict, dataclass

import numpy as np

from taxeld.arrays import Floats
from taxeld_hil.acceptance.values import CheckResult, Finding, Received
from taxeld_protocol.decoder import GAP_SHARE

RATE_OFF = 0.1  # of the period: a hub's clock is far better than that
JITTER_OFF = 1.0 - GAP_SHARE  # of the period: an earlier scan may be joined to the one before
MISSED = 0.01  # of the scans, without a damaged packet to explain them
DAMAGED = 0.001  # of the packets: CAN repeats what is damaged, so that none should be
SCANS_MIN = 10

_BUSY = (
    "close other programs on this machine; on a USB serial adapter set its latency timer to 1 ms "
    "(/sys/bus/usb-serial/devices/*/latency_timer)"
)
_WIRES = (
    "check the bus's ends (120 Ω at both), its shield and the length of its stubs; frames that are "
    f"lost between adapter and program show the same way: {_BUSY}"
)
_TABLE = (
    "the hub's module table changed, or two hubs share a short id: switch all hubs off and on, and "
    "connect one at a time"
)


@dataclass(frozen=True, slots=True)
class Rate:
    """The scans of one hub in time."""

    scans: int
    period_s: float  # median
    interval_s: Floats  # between complete scans
    off_s: Floats  # of each interval: from the nearest multiple of the period
    missed: int

    def off_ms(self, percentile: float) -> float:
        """How far scans come from their time [ms], at a percentile."""
        return float(1e3 * np.percentile(np.abs(self.off_s), percentile))


def rates(received: Received) -> dict[int, Rate]:
    """By hub; hubs with fewer than SCANS_MIN complete scans are left out."""
    found = {}
    for hub in received.tables:
        t = np.array([scan.t for scan in received.scans if scan.ihb == hub and scan.complete])
        if len(t) < SCANS_MIN:
            continue
        interval = np.diff(t)
        period = float(np.median(interval))
        steps = np.round(interval / period)
        tail = int((received.span[1] - t[-1]) / period) - 1  # it fell silent before the end
        missed = int((np.maximum(steps, 1) - 1).sum()) + max(tail, 0)
        found[hub] = Rate(len(t), period, interval, interval - steps * period, missed)
    return found


def rate(received: Received) -> CheckResult:
    """Scans come as often as they were asked for, evenly, and none is missing."""
    name, asked_s = "rate", received.period_ms / 1e3
    if not received.scans:
        return CheckResult(name, "no scan came", checked=False)
    by_hub = rates(received)
    findings = [
        Finding(
            f"hub {hub}",
            f"fewer than {SCANS_MIN} whole scans in the period",
            "see the check of the link; else ask for a longer --seconds",
        )
        for hub in {scan.ihb for scan in received.scans} - by_hub.keys()
    ]
    explained = received.link.damaged + received.link.orphan
    if received.link.lost or received.link.silences:  # faults of the link, and reported there
        explained = sum(one.missed for one in by_hub.values())
    for hub, one in by_hub.items():
        findings += _of_hub(f"hub {hub}", one, asked_s, explained)
    parts = [
        f"hub {hub}: {1.0 / one.period_s:.1f} Hz of {1.0 / asked_s:.1f} asked, "
        f"{one.off_ms(50):.1f} / {one.off_ms(95):.1f} / {one.off_ms(99):.1f} ms off "
        f"(50 / 95 / 99 %), {one.missed} of {one.scans + one.missed} missed"
        for hub, one in by_hub.items()
    ]
    figures = {
        str(hub): {
            "scans": one.scans,
            "missed": one.missed,
            "period_ms": 1e3 * one.period_s,
            "off_ms": {str(p): one.off_ms(p) for p in (50, 90, 95, 99, 100)},
        }
        for hub, one in by_hub.items()
    }
    return CheckResult(name, "; ".join(parts) or "too few scans", findings, figures=figures)


def _of_hub(hub: str, one: Rate, asked_s: float, explained: int) -> list[Finding]:
    findings = []
    if abs(one.period_s - asked_s) > RATE_OFF * asked_s:
        slow = one.period_s > asked_s
        findings.append(
            Finding(
                hub,
                f"a scan every {1e3 * one.period_s:.1f} ms, where {1e3 * asked_s:.0f} ms were "
                "asked for",
                "ask for fewer (--period-ms, and source.period_ms of the daemon) or raise the "
                "speed of the SPI (SET_COMM_SPEED)"
                if slow
                else "another host may drive this hub as well: stop it",
            )
        )
    off_ms, most_ms = one.off_ms(99), 1e3 * JITTER_OFF * one.period_s
    if off_ms > most_ms:
        findings.append(
            Finding(
                hub,
                f"one scan in a hundred comes {off_ms:.1f} ms or more off its time; "
                f"{most_ms:.1f} ms are allowed",
                _BUSY,
            )
        )
    missed = one.missed - explained
    if missed > MISSED * (one.scans + one.missed):
        findings.append(
            Finding(
                hub,
                f"{missed} of {one.scans + one.missed} scans did not come, and no packet was "
                "damaged",
                "the hub skips them: ask for fewer (--period-ms); else the adapter loses frames: "
                "check its buffer and " + _BUSY,
            )
        )
    return findings


def link(received: Received) -> CheckResult:
    """Whole packets, whose checksum and indices are right."""
    name, got = "link", received.link
    if not received.scans:
        return CheckResult(name, "no scan came", checked=False)
    findings = []
    if got.lost:
        findings.append(
            Finding(
                "the adapter",
                f"went away, {got.lost} × in the period",
                "check its plug, its cable and its supply",
            )
        )
    if got.silences:
        findings.append(
            Finding(
                "the adapter",
                f"fell silent, {got.silences} × in the period, until its channel was opened again",
                "another program may have closed it: stop that; else check its cable and supply",
            )
        )
    causes = {
        "with a wrong checksum": got.crc_errors,
        "of a wrong length": got.length_errors,
        "past the module table": got.index_errors,
        "that their command does not allow": got.malformed,
        "the driver could not read": got.undecodable,
    }
    all_packets = got.packets + got.damaged
    if got.damaged > DAMAGED * all_packets or got.orphan > DAMAGED * got.frames:
        parts = [f"{n} {cause}" for cause, n in causes.items() if n]
        if got.orphan:
            parts.append(f"{got.orphan} frames without the beginning of their packet")
        only_index = got.damaged == got.index_errors > 0
        cure = _TABLE if only_index else _WIRES
        findings.append(Finding("the bus", f"packets were damaged: {', '.join(parts)}", cure))
    notes = []
    if got.unknown:
        notes.append(f"{got.unknown} frames or packets of other devices; they are passed over")
    if got.unsent:
        notes.append(f"{got.unsent} requests could not be sent")
    if got.refused:
        notes.append(f"the adapter refused {got.refused} lines, named above")
    summary = (
        f"{all_packets} packets, wrong: checksum {got.crc_errors}, length {got.length_errors}, "
        f"index {got.index_errors}"
    )
    return CheckResult(name, summary, findings, notes, asdict(got))
