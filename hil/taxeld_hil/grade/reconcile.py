"""The daemon's counters against the ledger: nothing may be lost without being counted."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from taxeld_hil.grade.flags import value
from taxeld_hil.grade.session import Health
from taxeld_hil.rig.ledger import Fates

UNUSED = ("scans_old", "scans_from_the_future", "scans_waiting")
TAKEN = ("estimator.scans", "skin.learning", "skin.unmapped", "inputs.scans_without_pose")


class Law(NamedTuple):
    """Two numbers that must be equal, but for `slack`."""

    name: str
    expected: int  # count of the ledger, or of the daemon's other counters
    counted: int  # count of the daemon
    slack: int = 0

    @property
    def holds(self) -> bool:
        return abs(self.expected - self.counted) <= self.slack

    @property
    def text(self) -> str:
        slack = f" ± {self.slack}" if self.slack else ""
        return f"{self.counted} counted, {self.expected} expected{slack}"


def laws(ledger: Mapping[str, Any], health: Health, *, line: bool) -> list[Law]:
    """Laws for the host that listens, when nothing is in transit any more; `ledger` as its
    `entries`; `line`: of the native link. The counters of several links are added.

    Where the ledger knows no pauses, a busy host may have read the packets of a scan so far apart
    that it counts one scan more, and two incomplete ones in place of a whole one. Of the counts
    that this allows, the laws expect the nearest to the host's.
    """
    fates = Fates(**ledger["fates"])
    parts = [health, *[*health.get("links", {}).values()][1:]]  # the first stands for itself

    def counted(*names: str) -> int:
        return sum(value(part, name) for part in parts for name in names)

    scans, incomplete = counted("source.scans"), counted("source.incomplete")
    apart = 0 if ledger["knows_pauses"] else max(scans - fates.scans, 0)
    least, most = fates.incomplete + apart, fates.incomplete + 2 * apart
    used = counted("skin.scans", "source.late", *(f"inputs.{name}" for name in UNUSED))
    heard = counted("inputs.poses", "inputs.poses_rejected", "inputs.poses_malformed")
    # a foreign frame is of no known command
    strange = fates.index_errors + (0 if line else fates.foreign)
    refused = counted("source.index_errors", "source.malformed", "source.unknown")
    if line:
        errors = counted("source.crc_errors", "source.length_errors")
        found = [
            Law("bytes", fates.bytes, counted("source.bytes")),
            Law("lines damaged", fates.line_errors, errors),
        ]
    else:
        found = [
            Law("frames", fates.units, counted("source.frames")),
            Law("foreign frames", fates.foreign, counted("source.dropped.foreign")),
            Law("frames without a first", fates.orphan, counted("source.dropped.orphan")),
            Law("packets of wrong length", fates.length_errors, counted("source.length_errors")),
            Law("packets of wrong checksum", fates.crc_errors, counted("source.crc_errors")),
        ]
    if ledger["knows_pauses"]:
        slack = 20 * fates.unclear
        found.append(Law("scans missed", fates.missed, counted("source.missed"), slack))
    return [
        *found,
        Law("packets whole", fates.packets, counted("source.packets")),
        Law("packets of no module, malformed or unknown", strange, refused, fates.unclear),
        Law("packets before the modules", fates.undeclared, counted("source.undeclared")),
        Law("scans", fates.scans + apart, scans, fates.unclear),
        Law("scans incomplete", min(max(incomplete, least), most), incomplete, fates.unclear),
        Law("scans to the skin, refused or waiting", scans, used),
        Law("scans used, learned from or without a pose", counted("skin.scans"), counted(*TAKEN)),
        Law("poses", ledger["poses_heard"], heard),
    ]
