"""What an acceptance check gets and returns: values only, no device and no page."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import NamedTuple, Self

import numpy as np

from taxeld.arrays import Floats
from taxeld.layout.layout import Layout
from taxeld.source.sources import Source
from taxeld_protocol.decoder import Scan
from taxeld_protocol.modules import Module


class Verdict(Enum):
    """How a check ended."""

    PASSED = "passed"
    FAILED = "FAILED"
    NOT_CHECKED = "not checked"  # what it needs was not received, or not asked for


class Finding(NamedTuple):
    """One thing that is wrong."""

    where: str
    what: str
    cure: str


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One check's outcome; `figures` are for machines, and go to the JSON alone."""

    name: str
    summary: str
    findings: Sequence[Finding] = ()
    notes: Sequence[str] = ()  # worth knowing, and no fault
    figures: Mapping[str, object] = field(default_factory=dict)
    checked: bool = True

    @property
    def verdict(self) -> Verdict:
        if self.findings:
            return Verdict.FAILED
        return Verdict.PASSED if self.checked else Verdict.NOT_CHECKED


@dataclass(frozen=True, slots=True)
class Link:
    """Counters of a source: all that came over its wire, and what of it was damaged."""

    frames: int = 0
    bytes: int = 0
    packets: int = 0
    crc_errors: int = 0
    length_errors: int = 0
    index_errors: int = 0
    malformed: int = 0
    orphan: int = 0  # frames of a packet whose beginning was lost
    unknown: int = 0  # of other devices
    bootloader: int = 0  # answers of hubs whose modules are in their bootloader
    undecodable: int = 0  # reads that the CAN driver could not decode
    unsent: int = 0
    lost: int = 0  # times the device went away
    silences: int = 0  # times an SLCAN adapter fell silent
    refused: int = 0  # lines that it refused

    @classmethod
    def of(cls, source: Source) -> Self:
        """The counters as they stand."""
        stats = source.wire.stats()
        dropped = stats["dropped"]
        assert isinstance(dropped, dict)  # noqa: S101  (of CySkin's decoder)
        flat = {name: value for name, value in stats.items() if isinstance(value, int)}
        counters = source.counters
        return cls(
            **{name: flat[name] for name in _OF_WIRE},
            orphan=dropped["orphan"],
            undecodable=counters.noise,
            unsent=counters.unsent,
            lost=counters.lost,
            silences=counters.silences,
            refused=counters.refused,
        )

    def since(self, before: "Link") -> "Link":
        """What was counted after `before`."""
        then = asdict(before)
        return Link(**{name: value - then[name] for name, value in asdict(self).items()})

    @property
    def damaged(self) -> int:
        """Packets that came and could not be used."""
        return (
            self.crc_errors
            + self.length_errors
            + self.index_errors
            + self.malformed
            + self.undecodable
        )


_OF_WIRE = (
    "frames", "bytes", "packets", "crc_errors", "length_errors", "index_errors", "malformed",
    "unknown", "bootloader",
)  # fmt: skip


class Press(NamedTuple):
    """What was measured when the operator was asked to press a module."""

    asked: int  # module, as the layout counts them
    answered: int | None  # module that was pressed most; None: none in time
    peak: Floats  # (M,) most counts over the idle level


@dataclass(frozen=True, slots=True)
class Received:
    """All that was received from a skin: the checks are functions of this alone."""

    layout: Layout
    period_ms: int  # asked of the hub
    full_scale_counts: float
    tables: Mapping[int, Sequence[Module]]  # short id of each hub that declared itself → modules
    bring_up: Link  # from the first request to the beginning of the period
    link: Link = Link()  # over the period
    scans: Sequence[Scan] = ()  # of the period, in which nothing touched the skin
    span: tuple[float, float] = (0.0, 0.0)  # of the period, in the clock of the scans
    presses: Sequence[Press] | None = None  # None: not asked for

    @property
    def serials(self) -> list[int]:
        """Serial numbers (SUI) of the layout's modules, in the layout's order."""
        serials: list[int] = np.unique(self.layout.uid >> 4).tolist()
        return serials

    @property
    def places(self) -> dict[int, str]:
        """Serial number → where on which hub the module sits."""
        return {
            module.sui: f"hub {hub}, position {position}"
            for hub, modules in self.tables.items()
            for position, module in enumerate(modules)
            if module.sui is not None
        }


def name_of(uid: int) -> str:
    """A taxel's name within its module."""
    return f"T{uid & 0xF}"


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names in a line that stays readable."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")
