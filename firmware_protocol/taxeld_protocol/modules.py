"""The module table of a hub: which channels its SENSOR_DATA walks through, and whose they are.

DECLARE gives each module's channel count; MODULE_DETAILS its serial number (SUI) and the mask of
taxels that were not cut off. Channel k of a module is the k-th set bit of that mask, bit 0 being
the temperature T0; a taxel's UID is `SUI << 4 | name`.
"""

from dataclasses import asdict, dataclass, field, replace

from taxeld_protocol import commands
from taxeld_protocol.cyskin import Command

NAMES = 12  # T0..T11
MAX_MODULES = 248
ABSENT_UID = -1


@dataclass(frozen=True, slots=True)
class Module:
    """One triangular module as its hub describes it."""

    channels: int  # that SENSOR_DATA carries for it
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
    def uids(self) -> list[int]:
        """The UID of each channel, ABSENT_UID where it is not known."""
        known = [] if self.sui is None else [self.sui << 4 | name for name in self.names]
        return known + [ABSENT_UID] * (self.channels - len(known))


@dataclass(slots=True)
class ModuleTable:
    """The modules of one hub, filled from its answers; `version` changes with every change."""

    modules: list[Module] = field(default_factory=list)
    version: int = 0

    @property
    def declared(self) -> bool:
        return bool(self.modules)

    @property
    def detailed(self) -> bool:
        """Every module that has channels told its serial number."""
        return self.declared and all(m.sui is not None for m in self.modules if m.channels)

    @property
    def channels(self) -> int:
        return sum(module.channels for module in self.modules)

    def on_declare(self, payload: bytes) -> bool:
        """Take a DECLARE answer: `count | first | channels…`. False if it is malformed.

        An empty payload is the host's request and changes nothing.
        """
        if not payload:
            return True
        if len(payload) < 2:
            return False
        count, first, channels = payload[0], payload[1], payload[2:]
        in_range = first + len(channels) <= count <= MAX_MODULES
        if not in_range or any(c > NAMES for c in channels):
            return False
        modules = (self.modules + [Module(0)] * count)[:count]
        for i, value in enumerate(channels, first):
            if modules[i].channels != value:
                modules[i] = Module(value)
        self._take(modules)
        return True

    def on_details(self, payload: bytes) -> bool:
        """Take a MODULE_DETAILS answer of 11 bytes. False if it is malformed.

        One byte is the host's request and changes nothing.
        """
        if len(payload) == 1:
            return True
        fields = commands.parse_answer(Command.MODULE_DETAILS, payload)
        if fields is None:
            return False
        index = fields.pop("module")
        module = Module(**fields)
        if index >= MAX_MODULES or module.channels > NAMES or module.mask >= 1 << NAMES:
            return False
        modules = self.modules + [Module(0)] * (index + 1 - len(self.modules))
        modules[index] = module
        self._take(modules)
        return True

    def _take(self, modules: list[Module]) -> None:
        if modules != self.modules:
            self.modules = modules
            self.version += 1


def encode_details(index: int, module: Module) -> bytes:
    """The MODULE_DETAILS answer of a module whose serial number is known."""
    if module.sui is None:
        raise ValueError(f"module {index} has no serial number")
    return commands.answer(Command.MODULE_DETAILS, module=index, **asdict(module))


def wired(uids: list[int]) -> list[Module]:
    """The modules that taxels with these UIDs hang on, each with its T0, in order of SUI."""
    masks: dict[int, int] = {}
    for uid in uids:
        masks[uid >> 4] = masks.get(uid >> 4, 1) | 1 << (uid & 0xF)
    empty = Module(0)
    return [
        replace(empty, channels=mask.bit_count(), sui=sui, mask=mask)
        for sui, mask in sorted(masks.items())
    ]
