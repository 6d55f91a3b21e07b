"""The fault injector: a scenario's faults, applied to units, counts and poses.

It has no clock and draws from a seeded generator, so that a run on the fake clock and one in real
time get the same faults. The ledger counts all that it does.
"""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from taxeld_hil.rig.ledger import Ledger, WireUnit
from taxeld_hil.scenario.scenario import Fault
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import DELIMITER

FOREIGN_IDS = (0x000, 0x300, 0x600, 0x700)  # assembly bits that are no fragment's
COUNT_MAX = 0xFFFF
PoseRow = tuple[float, float, float, float]  # t, x, y, θ
T = TypeVar("T")


class Injector:
    """Faults by time. Times must not go back."""

    def __init__(
        self,
        faults: Sequence[Fault],
        seed: int,
        ledger: Ledger,
        modules: Sequence[Sequence[int]],
        taxels: Mapping[int, int],
    ) -> None:
        """`modules`: the channels of each module's taxels; `taxels`: the channel of each taxel."""
        self._faults = sorted(faults, key=lambda fault: fault.at_s)
        self._rng = np.random.default_rng([seed, 1])
        self._done = ledger.done
        self._modules, self._taxels = modules, taxels
        # with the times when they are due
        self._late, self._late_poses = list[tuple[float, WireUnit]](), list[tuple[float, PoseRow]]()
        self._swapped: WireUnit | None = None
        self._stuck: dict[int, int] = {}
        self._frozen: PoseRow | None = None
        self._flooded_s: float | None = None

    def fault(self, kind: str, t: float) -> Fault | None:
        """The fault of this kind at time t, the last to begin of several."""
        on = (f for f in self._faults if f.kind == kind and f.at_s <= t < f.end_s)
        return max(on, key=lambda fault: fault.at_s, default=None)

    def is_quiet(self, t: float) -> bool:
        """Whether units pass unchanged."""
        return self._swapped is None and not any(f.at_s <= t < f.end_s for f in self._faults)

    def counts(self, counts: list[int], t: float) -> list[int | None]:
        """A scan as the faulty skin reads it; None where a module sends nothing."""
        out: list[int | None] = list(counts)
        if fault := self._acts("baseline_jump", t):
            for c in self._channels(fault):
                out[c] = int(min(max(counts[c] + fault.counts, 1), COUNT_MAX - 1))
        if fault := self._acts("taxel_stuck", t):
            for c in self._channels(fault):
                out[c] = self._stuck.setdefault(c, counts[c])
        else:
            self._stuck = {}
        if fault := self._acts("saturated", t):
            for c in self._channels(fault):
                out[c] = COUNT_MAX
        if fault := self._acts("module_dead", t):
            channels = self._modules[fault.module]
            out[channels[0] - 1 : channels[-1] + 1] = [None] * (len(channels) + 1)  # with T0
        return out

    def unit(self, unit: WireUnit, t: float) -> list[WireUnit]:
        """The units on the wire when the hub sends this one."""
        if self._hits("dropped", t):
            return []
        if self._hits("corrupted", t):
            unit = self._damaged(unit)
        if fault := self._hits("late", t):
            self._late.append((t + fault.delay_s, unit))
            return []
        if self._swapped is None and self._hits("reordered", t):
            self._swapped = unit
            return []
        out = [unit, unit] if self._hits("duplicated", t) else [unit]
        if self._swapped is not None:
            out.append(self._swapped)
            self._swapped = None
        return out

    def due(self, t: float, *, line: bool) -> list[WireUnit]:
        """Late units whose time has come, and what floods the bus (or the `line`) meanwhile."""
        out, fault = _ready(self._late, t), self.fault("flooded", t)
        if fault is None:
            self._flooded_s = None
            return out
        since = t if self._flooded_s is None else self._flooded_s
        number = int((t - since) * fault.per_s)
        self._flooded_s = since + number / fault.per_s
        self._done["flooded"] += number
        return out + [self._foreign(t, line=line) for _ in range(number)]

    def flush(self) -> list[WireUnit]:
        """All that is held back, at the end of a run, or as the device is gone."""
        out = _ready(self._late, np.inf) + ([] if self._swapped is None else [self._swapped])
        self._swapped = None
        return out

    def poses(self, row: PoseRow, t: float) -> list[PoseRow]:
        """The poses that the robot publishes at scenario time t, when it is at this one."""
        if self._acts("pose_frozen", t):
            self._frozen = self._frozen or row
            row = (row[0], *self._frozen[1:])
        else:
            self._frozen = None
        if fault := self._hits("pose_jumping", t):
            row = (row[0], row[1] + fault.offset_m, row[2], row[3])
        out = [] if self._acts("pose_silent", t) else [row]
        if out and (fault := self._acts("pose_late", t)):
            self._late_poses.append((t + fault.delay_s, row))
            out = []
        return _ready(self._late_poses, t) + out

    def _acts(self, kind: str, t: float) -> Fault | None:
        fault = self.fault(kind, t)
        if fault is not None:
            self._done[kind] += 1
        return fault

    def _hits(self, kind: str, t: float) -> Fault | None:
        """The fault, if it hits this frame or pose: by its share."""
        fault = self.fault(kind, t)
        if fault is None or (fault.share < 1.0 and self._rng.random() >= fault.share):
            return None
        self._done[kind] += 1
        return fault

    def _channels(self, fault: Fault) -> Sequence[int]:
        if fault.taxels:
            return [self._taxels[taxel] for taxel in fault.taxels]
        return self._modules[fault.module]

    def _damaged(self, unit: WireUnit) -> WireUnit:
        """The unit with one bit flipped, in a frame's data or in a line before its end."""
        assert not isinstance(unit.item, ArrayFrame)  # noqa: S101  (they come whole)
        data = unit.item if isinstance(unit.item, bytes) else unit.item.data
        end = len(data) - isinstance(unit.item, bytes)
        at, bit = int(self._rng.integers(end)), 1 << int(self._rng.integers(8))
        if isinstance(unit.item, bytes) and data[at] == bit:
            bit = bit << 1 if bit < 0x80 else 1  # a line's only zero is at its end
        damaged = data[:at] + bytes((data[at] ^ bit,)) + data[at + 1 :]
        if isinstance(unit.item, bytes):
            return unit._replace(item=damaged)
        return unit._replace(item=unit.item._replace(data=damaged))

    def _foreign(self, t: float, *, line: bool) -> WireUnit:
        data = self._rng.bytes(8)
        if line:
            return WireUnit(b"\xff" + data.replace(b"\0", b"\1") + DELIMITER, None)
        can_id = FOREIGN_IDS[int(self._rng.integers(4))] | int(self._rng.integers(0x100))
        return WireUnit(Frame(t, can_id, data), None)


def _ready(waiting: list[tuple[float, T]], t: float) -> list[T]:
    """Take what is due, in the order of its times."""
    ready = sorted((each for each in waiting if each[0] <= t), key=lambda each: each[0])
    waiting[:] = [each for each in waiting if each[0] > t]
    return [item for _, item in ready]
