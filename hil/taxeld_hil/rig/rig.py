"""The virtual skin on its moving robot, with a scenario's faults; it has no clock and no transport.

Its owner steps it through scenario time and delivers what it sends. Until a host starts the skin,
scenario time stands still at BEFORE_S.
"""

from collections.abc import Sequence
from itertools import accumulate, pairwise

from taxeld.errors import SetupError
from taxeld_hil.rig.faults import Injector, PoseRow
from taxeld_hil.rig.ledger import Ledger, Sent, WireUnit
from taxeld_hil.rig.virtual_ihb import Phase, VirtualIhb
from taxeld_hil.scenario.scenario import SKIN_KINDS, Fault, Scenario
from taxeld_hil.scenario.staged import world_of
from taxeld_protocol import cyskin, serial_link
from taxeld_protocol.array import ArrayFrame, Group
from taxeld_protocol.cyskin import Command, Packet
from taxeld_protocol.modules import NAMES, Module, is_of_bootloader, wired
from taxeld_sim.world.world import LINK_SEEDS, World

POSE_PERIOD_S = 0.01
POSE_AGE_S = 0.004  # age of a pose in its message: scans fall between poses
BRIEF_S = 1e-6  # sums of periods are not exact
ADVICE_S = 10.0  # that the robot waits for advice
SETTLE_S = 1.0  # after the last fault, beyond the time it may take to recover
ARRAY_ID = "skin"
HUB_UID = 0xC15C0001  # of the first link's
# a hub that speaks the native link has left its own bootloader, which speaks CAN alone; what sends
# an array has no host to start it
PHASES = {"native": Phase.MODULES, "array": Phase.RUNNING}
BEFORE_S = -1.0  # scenario time while no host has started the skin


class Rig:
    """A scenario with a seed: hub, world, robot, injector and ledger."""

    def __init__(
        self, scenario: Scenario, seed: int, link: int = 0, world: World | None = None
    ) -> None:
        """`scenario`: of the link of this number; `world`: of all links, where there are several.

        Raises:
            SetupError: skin or object cannot be loaded, or a fault or the transport does not fit
                them.
        """
        self.world = world or world_of(scenario, seed)
        self._link = link
        self.model = self.world.links[link]
        self.scenario = scenario
        self._taxel_uids: list[int] = self.model.layout.uid.tolist()
        self.line = scenario.transport == "native"
        self.is_array = scenario.transport == "array"
        self.modules = wired(self._taxel_uids, Group if self.is_array else Module)
        uids = [uid for module in self.modules for uid in module.uids]
        self._channel = {uid: c for c, uid in enumerate(uids)}
        if not self._channel.keys() >= set(self._taxel_uids):
            raise SetupError(
                f"transport: {scenario.transport} is of modules with taxels 1..{NAMES - 1}, and "
                f"{self.model.layout.name} has other UIDs: it comes as an array, "
                "without --can"
            )
        phase = PHASES.get(scenario.transport, Phase.BOOTLOADER)
        self.hub = VirtualIhb(self.modules, HUB_UID + link, phase=phase)
        channels = tuple(module.channels for module in self.modules)
        self.ledger = Ledger(channels, self.hub.period_ms / 1000.0)
        self._first = [0, *accumulate(channels)]
        self._was_on = True
        self._next_pose_s = -1e9
        for number, fault in enumerate(scenario.fault):
            self._check(fault, number)
        taxels = {i: self._channel[uid] for i, uid in enumerate(self._taxel_uids)}
        of_modules = [range(first + 1, end) for first, end in pairwise(self._first)]
        seed += LINK_SEEDS * link
        self._injector = Injector(scenario.fault, seed, self.ledger, of_modules, taxels)

    def _check(self, fault: Fault, number: int) -> None:
        """Raises SetupError where a fault names a module or taxel that the skin does not have."""
        modules, taxels = len(self.modules), len(self._taxel_uids)
        if fault.kind in SKIN_KINDS and fault.module >= modules:
            raise SetupError(f"fault[{number}].module: the skin has 0..{modules - 1}")
        if not all(0 <= taxel < taxels for taxel in fault.taxels):
            raise SetupError(f"fault[{number}].taxels: the skin has 0..{taxels - 1}")

    @property
    def duration_s(self) -> float:
        """To the end of the path, and of the last fault's recovery."""
        ends = [fault.end_s for fault in self.scenario.fault]
        last = max(ends, default=0.0) + self.scenario.expect.recovery_s + SETTLE_S
        waits = self.scenario.advised and self.world.touches < self.scenario.contacts
        rest_s = ADVICE_S if waits else self.scenario.rest_s
        return max(self.world.duration_s + rest_s, last if ends else 0.0)

    def taxels_of(self, fault: Fault) -> list[int]:
        """The taxels that a fault is about, as the layout numbers them."""
        if fault.taxels:
            return list(fault.taxels)
        uids = set(self.modules[fault.module].uids)
        return [i for i, uid in enumerate(self._taxel_uids) if uid in uids]

    def fails(self, kind: str, t: float) -> bool:
        """Whether a fault of this kind is on; asked for those that the rig's owner carries out."""
        return self._injector.fault(kind, t) is not None

    def is_on(self, t: float) -> bool:
        """Whether the hub has power and its firmware runs."""
        return not self.fails("reboot", t) and not self.fails("unplugged", t)

    def answer(self, packet: Packet, t: float) -> list[WireUnit]:
        """The answers to a host's request."""
        if not self._power(t):
            return []
        answers = self.hub.answer(packet)
        return [unit for answer in answers for unit in self._send(*answer, t)]

    def scan(self, t: float, now: float) -> list[WireUnit]:
        """The hub's units at scenario time t; `now` is the clock of its period."""
        if not self._power(t):
            return []
        out = [] if self.is_array else self._injector.due(t, line=self.line)
        if t >= 0.0 and self.hub.due(now):
            counts = self._injector.counts(self.world.step(t, self._link).counts, t)
            if self.is_array:
                return [self._array(counts)]
            for answer in self.hub.sensor_data(counts):
                out += self._send(*answer, t)
        return out

    def rest(self) -> list[WireUnit]:
        """The units that faults held back, at the end."""
        return self._injector.flush()

    def poses(self, t: float, now: float, wall: float) -> list[PoseRow]:
        """The robot's poses, stamped with Unix time `wall`, which may be set; `now` as for
        `scan`."""
        if now < self._next_pose_s - BRIEF_S:
            return []
        self._next_pose_s = max(self._next_pose_s + POSE_PERIOD_S, now)
        x, y, theta = self.world.stated(t - POSE_AGE_S, self._link).tolist()
        rows = self._injector.poses((wall - POSE_AGE_S, x, y, theta), t)
        self.ledger.poses_sent += len(rows)
        return rows

    def _power(self, t: float) -> bool:
        on = self.is_on(t)
        if self._was_on and not on:  # a hub without power forgets its settings
            self.hub.reboot()
            self.hub.auto_sync = self.is_array
            self._injector.flush()
        self._was_on = on
        return on

    def _array(self, counts: Sequence[int | None]) -> WireUnit:
        """The scan as an array of the layout's taxels."""
        taxels = (counts[self._channel[uid]] or 0 for uid in self._taxel_uids)
        return WireUnit(ArrayFrame(0.0, ARRAY_ID, 0, tuple(taxels)), None)

    def _send(self, command: int, payload: bytes, t: float) -> list[WireUnit]:
        if self.line:
            line = serial_link.encode(command, payload, ihb=self.hub.short_id)
            units = [WireUnit(line, self._sent(line, command, payload, 1))]
        else:
            data = cyskin.encode(command, payload)
            frames = cyskin.fragment(data, self.hub.short_id)
            sent = self._sent(data, command, payload, len(frames))
            units = [WireUnit(frame, sent, i) for i, frame in enumerate(frames)]
        if self._injector.is_quiet(t):
            return units
        return [out for unit in units for out in self._injector.unit(unit, t)]

    def _sent(self, data: bytes, command: int, payload: bytes, fragments: int) -> Sent:
        if command != Command.SENSOR_DATA:
            declares = command == Command.DECLARE and not is_of_bootloader(command, payload)
            return Sent(data, command, fragments, declares=declares)
        start = self._first[payload[0]] + payload[1]
        return Sent(data, command, fragments, start, len(payload) // 2 - 1)


def rigs_of(scenario: Scenario, seed: int) -> list[Rig]:
    """A rig for each link, which touch the object in turn.

    Raises:
        SetupError: as of `Rig`, or the links do not fit the scenario's other keys.
    """
    scenario.check_links()
    world = world_of(scenario, seed)
    return [Rig(scenario.of_link(k), seed, k, world) for k in range(scenario.links)]
