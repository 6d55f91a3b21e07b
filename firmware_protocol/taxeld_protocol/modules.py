"""The module table of a hub: which channels its SENSOR_DATA walks through, and whose they are.

DECLARE gives the number of channels that each module sends. MODULE_DETAILS gives its serial number
(SUI) and the mask of taxels that were not cut off; its own number of channels is of those possible,
12 of a cut module too, and says nothing about what is sent. Where no DECLARE was heard, a module
sends as many channels as its mask has bits. Channel k is the k-th set bit of the mask, bit 0 being
the temperature T0; a taxel's UID is `SUI << 4 | name`.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from taxeld_protocol import commands
from taxeld_protocol.cyskin import Command

NAMES = 12  # T0..T11
ALL_NAMES = (1 << NAMES) - 1
MAX_MODULES = 248
ABSENT_UID = -1

BOOTLOADER_BYTES = {  # lengths of answers while the modules are in their bootloader
    Command.DECLARE: 1,  # the number of modules
    Command.MODULE_DETAILS: 5,  # module u8, SUI u32
}


@dataclass(frozen=True, slots=True)
class Module:
    """One triangular module as its hub describes it."""

    channels: int  # number that SENSOR_DATA carries for it
    sui: int | None = None  # None until MODULE_DETAILS was heard
    mask: int = 0  # uncut taxels, LSB = T0
    grouping: int = 0
    cdc_control: int = 0
    cdc_speed: int = 0

    @property
    def names(self) -> list[int]:
        """The taxel name of each channel, as far as the mask tells."""
        return [bit for bit in range(NAMES) if self.mask >> bit & 1][: self.channels]

    @property
    def fault(self) -> str:
        """Why its channels have no known names, and the cure: with such a module the vendor's
        library refuses the hub. Empty where they have."""
        named = self.mask.bit_count()
        if self.sui is None or not self.channels or (not self.grouping and self.channels == named):
            return ""
        what, cure = f"is grouped (grouping {self.grouping})", "end its grouping"
        if not self.grouping:
            what = f"declares {self.channels} channels, but its mask {self.mask:#05x} has {named}"
            cure = "set its mask anew"
        return (
            f"{what}, so which taxel is which is not known; {cure} with the vendor's tool, and "
            "switch the hub off and on"
        )

    @property
    def uids(self) -> list[int]:
        """The UID of each channel, ABSENT_UID where it is not known."""
        known = [] if self.sui is None else [self.sui << 4 | name for name in self.names]
        return known + [ABSENT_UID] * (self.channels - len(known))


@dataclass(slots=True)
class ModuleTable:
    """The modules of one hub, filled from its answers; `version` changes with every change."""

    modules: list[Module] = field(default_factory=list)  # up to the first unknown one
    version: int = 0
    in_bootloader: bool = False  # whether its last answer says so
    fault: str = ""  # a line on a module whose channels have no known names; or empty
    _size: int = 0  # number of modules, as far as known
    _counts: dict[int, int] = field(default_factory=dict)  # module → channels by DECLARE
    _details: dict[int, Module] = field(default_factory=dict)  # with possible channels, not sent

    def __post_init__(self) -> None:
        """`modules` that are given are as if heard."""
        self._size = len(self.modules)
        for i, module in enumerate(self.modules):
            self._counts[i] = module.channels
            if module.sui is not None:
                self._details[i] = module

    @property
    def declared(self) -> bool:
        return bool(self.modules)

    @property
    def complete(self) -> bool:
        """Every module is known, and told its serial number if it has channels."""
        known = len(self.modules) == self._size
        return known and all(m.sui is not None for m in self.modules if m.channels)

    @property
    def detailed(self) -> bool:
        """There are modules, and all of them are known so."""
        return self.declared and self.complete

    def on_declare(self, payload: bytes) -> bool:
        """Take a DECLARE answer: `count | first | channels…`. False if it is malformed.

        An empty payload is the host's request and changes nothing.
        """
        if not payload:
            return True
        if is_of_bootloader(Command.DECLARE, payload):
            self.in_bootloader = True
            return True
        count, first, channels = payload[0], payload[1], payload[2:]
        in_range = first + len(channels) <= count <= MAX_MODULES
        if not in_range or any(c > NAMES for c in channels):
            return False
        self.in_bootloader = False
        self._size = count
        self._counts = {i: known for i, known in self._counts.items() if i < count}
        self._details = {i: known for i, known in self._details.items() if i < count}
        for i, value in enumerate(channels, first):
            if self._counts.get(i, value) != value:  # cut anew: the details are of before
                self._details.pop(i, None)
            self._counts[i] = value
        self._take()
        return True

    def on_details(self, payload: bytes) -> bool:
        """Take a MODULE_DETAILS answer of 11 bytes. False if it is malformed.

        One byte is the host's request and changes nothing.
        """
        if len(payload) == 1:
            return True
        if is_of_bootloader(Command.MODULE_DETAILS, payload):
            self.in_bootloader = True
            return True
        fields = commands.parse_answer(Command.MODULE_DETAILS, payload)
        if fields is None:
            return False
        index = fields.pop("module")
        module = Module(**fields)
        if index >= MAX_MODULES or module.channels > NAMES or module.mask > ALL_NAMES:
            return False
        self.in_bootloader = False
        before = self._details.get(index)
        if before is not None and before.mask != module.mask:  # cut since it was declared
            self._counts.pop(index, None)
        self._size = max(self._size, index + 1)
        self._details[index] = module
        self._take()
        return True

    def _take(self) -> None:
        """Make the modules from what is known of them."""
        modules: list[Module] = []
        for i in range(self._size):
            details, count = self._details.get(i), self._counts.get(i)
            if details is not None:
                sent = details.mask.bit_count() if count is None else count
                modules.append(replace(details, channels=sent))
            elif count is not None:
                modules.append(Module(count))
            else:
                break  # the channels of the next modules have no known place
        if modules != self.modules:
            self.modules = modules
            self.version += 1
            self.fault = next((f"module {m.sui} {m.fault}" for m in modules if m.fault), "")


def is_of_bootloader(command: int, payload: bytes) -> bool:
    """Whether the answer is of a hub whose modules are in their bootloader."""
    return BOOTLOADER_BYTES.get(command) == len(payload)  # type: ignore[call-overload,no-any-return]


def listed(pairs: Iterable[tuple[int, int]]) -> list[Module]:
    """Modules by SUI and mask, in this order; each sends what its mask has."""
    return [Module(mask.bit_count(), sui, mask) for sui, mask in pairs]


def wired(uids: list[int], kind: type[Module] = Module) -> list[Module]:
    """The modules that taxels with these UIDs hang on, each with its T0, in order of SUI."""
    masks: dict[int, int] = {}
    for uid in uids:
        masks[uid >> 4] = masks.get(uid >> 4, 1) | 1 << (uid & 0xF)
    return [kind(mask.bit_count(), sui, mask) for sui, mask in sorted(masks.items())]
