"""The daemon's counters against the ledger: nothing may be lost without being counted."""

from typing import Any, NamedTuple

from taxeld_hil.grade.flags import value
from taxeld_hil.rig.ledger import Ledger


class Law(NamedTuple):
    """Two numbers that must be equal, but for `slack`."""

    name: str
    expected: int  # count of the ledger, or of the daemon's other counters
    counted: int  # count of the daemon
    slack: int = 0

    @property
    def holds(self) -> bool:
        return abs(self.expected - self.counted) <= self.slack


def laws(ledger: Ledger, health: dict[str, Any], *, line: bool) -> list[Law]:
    """Laws for the host that listens, when nothing is in transit any more; `line`: of the native
    link.

    Where the ledger knows no pauses, a busy host may have read the packets of a scan so far apart
    that it counts one scan more, and two incomplete ones in place of a whole one. Of the counts
    that this allows, the laws expect the nearest to the host's.
    """
    fates = ledger.fates

    def counted(name: str) -> int:
        return value(health, name)

    scans, incomplete = counted("source.scans"), counted("source.incomplete")
    apart = 0 if ledger.knows_pauses else max(scans - fates.scans, 0)
    least, most = fates.incomplete + apart, fates.incomplete + 2 * apart
    found = _line(ledger, health) if line else _frames(ledger, health)
    found += [
        Law("packets whole", fates.packets, counted("source.packets")),
        Law(
            "packets of no module, malformed or unknown",
            # a foreign frame is of no known command
            fates.index_errors + (0 if line else fates.foreign),
            counted("source.index_errors")
            + counted("source.malformed")
            + counted("source.unknown"),
            fates.unclear,
        ),
        Law("packets before the modules", fates.undeclared, counted("source.undeclared")),
        Law("scans", fates.scans + apart, scans, fates.unclear),
        Law("scans incomplete", min(max(incomplete, least), most), incomplete, fates.unclear),
    ]
    if ledger.knows_pauses:
        missed = counted("source.missed")
        found.append(Law("scans missed", fates.missed, missed, 20 * fates.unclear))
    return found + _onwards(ledger, health)


def summed(health: dict[str, Any]) -> dict[str, Any]:
    """The counters of several links, added as if they were one's. The first stands for itself."""
    total = dict(health)
    for part in [*health.get("links", {}).values()][1:]:
        for name in ("source", "inputs", "skin"):
            total[name] = _added(total[name], part.get(name, {}))
    return total


def _added(one: dict[str, Any], two: dict[str, Any]) -> dict[str, Any]:
    found = dict(one)
    for name, more in two.items():
        if isinstance(more, dict):
            found[name] = _added(one.get(name, {}), more)
        elif isinstance(more, (int, float)):
            found[name] = one.get(name, 0) + more
    return found


def _frames(ledger: Ledger, health: dict[str, Any]) -> list[Law]:
    fates = ledger.fates
    return [
        Law("frames", fates.units, value(health, "source.frames")),
        Law("foreign frames", fates.foreign, value(health, "source.dropped.foreign")),
        Law("frames without a first", fates.orphan, value(health, "source.dropped.orphan")),
        Law("packets of wrong length", fates.length_errors, value(health, "source.length_errors")),
        Law("packets of wrong checksum", fates.crc_errors, value(health, "source.crc_errors")),
    ]


def _line(ledger: Ledger, health: dict[str, Any]) -> list[Law]:
    fates = ledger.fates
    errors = value(health, "source.crc_errors") + value(health, "source.length_errors")
    return [
        Law("bytes", fates.bytes, value(health, "source.bytes")),
        Law("lines damaged", fates.line_errors, errors),
    ]


def _onwards(ledger: Ledger, health: dict[str, Any]) -> list[Law]:

    def counted(name: str) -> int:
        return value(health, name)

    unused = ("scans_old", "scans_from_the_future", "scans_waiting")
    used = counted("skin.scans") + sum(counted(f"inputs.{name}") for name in unused)
    used += counted("source.late")
    taken = (
        counted("estimator.scans")
        + counted("skin.learning")
        + counted("skin.unmapped")
        + counted("inputs.scans_without_pose")
    )
    poses = counted("inputs.poses") + counted("inputs.poses_rejected")
    return [
        Law("scans to the skin, refused or waiting", counted("source.scans"), used),
        Law("scans used, learned from or without a pose", counted("skin.scans"), taken),
        Law("poses", ledger.poses_heard, poses + counted("inputs.poses_malformed")),
    ]
