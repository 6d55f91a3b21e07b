"""The fault injector: a scenario's faults, applied to units, counts and poses.

It has no clock and draws from a seeded generator, so that a run on the fake clock and one in real
time get the same faults. The ledger counts all that it does.
"""

import heapq
from collections.abc import Mapping, Sequence
from itertools import count

import numpy as np

from taxeld_hil.rig.ledger import Ledger, WireUnit
from taxeld_hil.scenario.scenario import Fault
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.frames import Frame
from taxeld_protocol.serial_link import DELIMITER

FOREIGN_IDS = (0x000, 0x300, 0x600, 0x700)  # assembly bits that are no fragment's
COUNT_MAX = 0xFFFF
PoseRow = tuple[float, float, float, float]  # t, x, y, θ


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
        self._ledger = ledger
        self._modules, self._taxels = modules, taxels
        self._active: dict[str, Fault] = {}
        self._edge_s = -np.inf  # when `_active` changes next
        self._order = count()
        self._late: list[tuple[float, int, WireUnit]] = []
        self._late_poses: list[tuple[float, PoseRow]] = []
        self._swapped: WireUnit | None = None
        self._stuck: dict[int, int] = {}
        self._frozen: PoseRow | None = None
        self._flooded_s: float | None = None

    def active(self, t: float) -> dict[str, Fault]:
        """The faults at time t, by kind."""
        if t >= self._edge_s:
            before = self._active
            self._faults = [fault for fault in self._faults if fault.end_s > t]
            self._active = {f.kind: f for f in self._faults if f.at_s <= t}
            edges = [f.end_s if f.at_s <= t else f.at_s for f in self._faults]
            self._edge_s = min(edges, default=np.inf)
            for kind, fault in self._active.items():
                self._ledger.done[f"{kind} windows"] += before.get(kind) is not fault
        return self._active

    def is_quiet(self, t: float) -> bool:
        """Whether units pass unchanged."""
        return not self.active(t) and self._swapped is None

    def counts(self, counts: list[int], t: float) -> list[int | None]:
        """A scan as the faulty skin reads it; None where a module sends nothing."""
        active = self.active(t)
        out: list[int | None] = list(counts)
        if fault := active.get("baseline_jump"):
            for c in self._channels(fault):
                out[c] = int(min(max(counts[c] + fault.counts, 1), COUNT_MAX - 1))
            self._ledger.done["baseline_jump"] += 1
        if fault := active.get("taxel_stuck"):
            for c in self._channels(fault):
                out[c] = self._stuck.setdefault(c, counts[c])
            self._ledger.done["taxel_stuck"] += 1
        else:
            self._stuck = {}
        if fault := active.get("saturated"):
            for c in self._channels(fault):
                out[c] = COUNT_MAX
            self._ledger.done["saturated"] += 1
        if fault := active.get("module_dead"):
            channels = self._modules[fault.module]
            out[channels[0] - 1 : channels[-1] + 1] = [None] * (len(channels) + 1)  # with T0
            self._ledger.done["module_dead"] += 1
        return out

    def unit(self, unit: WireUnit, t: float) -> list[WireUnit]:
        """The units on the wire when the hub sends this one."""
        active, done = self.active(t), self._ledger.done
        if self._hits(active.get("dropped")):
            done["dropped"] += 1
            return []
        if self._hits(active.get("corrupted")):
            done["corrupted"] += 1
            unit = self._damaged(unit)
        if self._hits(active.get("late")):
            done["late"] += 1
            entry = t + active["late"].delay_s, next(self._order), unit
            heapq.heappush(self._late, entry)
            return []
        if self._swapped is None and self._hits(active.get("reordered")):
            done["reordered"] += 1
            self._swapped = unit
            return []
        out = [unit]
        if self._hits(active.get("duplicated")):
            done["duplicated"] += 1
            out.append(unit)
        if self._swapped is not None:
            out.append(self._swapped)
            self._swapped = None
        return out

    def due(self, t: float, *, line: bool) -> list[WireUnit]:
        """Late units whose time has come, and what floods the bus (or the `line`) meanwhile."""
        out = []
        while self._late and self._late[0][0] <= t:
            out.append(heapq.heappop(self._late)[2])
        fault = self.active(t).get("flooded")
        if fault is None:
            self._flooded_s = None
            return out
        since = t if self._flooded_s is None else self._flooded_s
        number = int((t - since) * fault.per_s)
        self._flooded_s = since + number / fault.per_s
        self._ledger.done["flooded"] += number
        return out + [self._foreign(t, line=line) for _ in range(number)]

    def flush(self) -> list[WireUnit]:
        """All that is held back, at the end of a run."""
        out = [unit for _, _, unit in sorted(self._late)]
        if self._swapped is not None:
            out.append(self._swapped)
        self._late, self._swapped = [], None
        return out

    def drop_held(self) -> None:
        """Forget what is held back, as the device is gone."""
        self._late, self._swapped = [], None

    def poses(self, row: PoseRow, t: float) -> list[PoseRow]:
        """The poses that the robot publishes at scenario time t, when it is at this one."""
        active, done = self.active(t), self._ledger.done
        out = [row]
        if "pose_frozen" in active:
            done["pose_frozen"] += 1
            self._frozen = self._frozen or row
            out = [(row[0], *self._frozen[1:])]
        else:
            self._frozen = None
        if self._hits(active.get("pose_jumping")):
            done["pose_jumping"] += 1
            out = [(row[0], row[1] + active["pose_jumping"].offset_m, row[2], row[3])]
        if "pose_silent" in active:
            done["pose_silent"] += 1
            out = []
        if fault := active.get("pose_late"):
            done["pose_late"] += len(out)
            self._late_poses += [(t + fault.delay_s, late) for late in out]
            out = []
        ready = sum(due <= t for due, _ in self._late_poses)
        released = [late for _, late in self._late_poses[:ready]]
        del self._late_poses[:ready]
        return released + out

    def _channels(self, fault: Fault) -> Sequence[int]:
        if fault.taxels:
            return [self._taxels[taxel] for taxel in fault.taxels]
        return self._modules[fault.module]

    def _hits(self, fault: Fault | None) -> bool:
        return fault is not None and (fault.share >= 1.0 or self._rng.random() < fault.share)

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
