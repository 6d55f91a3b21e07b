"""The configuration: one dataclass a table, every key with its type, default and bounds.

Names of keys end in their units.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import TypeVar

from taxeld.config.gate import between, key, one_of, unwritten
from taxeld_protocol.cyskin import BROADCAST
from taxeld_protocol.modules import ALL_NAMES, MAX_MODULES
from taxeld_protocol.slcan import BITRATES

T = TypeVar("T")

SIZES = ("particles", "particles_max", "injected")  # keys of the filter's size
OBJECTS_MAX = 16  # objects that one skin may touch
LINKS_MAX = 8
KINDS = ("can", "serial", "array")  # of sources
LEVELS = ("debug", "info", "warning", "error")  # levels of the log
SENSOR_POSE = "/robot/sensor_pose"  # a single link's topic


def modules_fault(modules: tuple[tuple[int, ...], ...]) -> str | None:
    for entry in modules:
        if len(entry) not in (2, 3) or len(entry) != len(modules[0]):
            return f"{list(entry)}: must be [SUI, mask], or all [SUI, mask, hub]"
        sui, mask, hub = (*entry, 1)[:3]
        if not (0 <= sui < 1 << 32 and 0 <= mask <= ALL_NAMES and 0 < hub < BROADCAST):
            spans = f"SUI 0..4294967295, mask 0..{ALL_NAMES:#x}, hub 1..{BROADCAST - 1}"
            return f"{list(entry)}: is out of range: {spans}"
    if twice := _twice(sui for sui, mask, *_ in modules if mask):
        return f"lists module {twice[0]} more than once"
    if max(Counter(tuple(hub) for _, _, *hub in modules).values(), default=0) > MAX_MODULES:
        return f"lists more than the {MAX_MODULES} modules that a hub can have"
    return None


def _bundles(bundles: tuple[str, ...]) -> str | None:
    if twice := _twice(bundles):
        return f"names {twice[0]!r:.100} more than once"
    if len(bundles) > OBJECTS_MAX:
        return f"names {len(bundles)} objects; {OBJECTS_MAX} are told apart at most"
    return None


def _twice(values: Iterable[T]) -> list[T]:
    return [value for value, times in Counter(values).items() if times > 1]


@dataclass(frozen=True, slots=True)
class SkinConfig:
    """`[skin]`: how counts become activations."""

    layout: str = key(
        "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015", doc="where the taxels are"
    )
    full_scale_counts: float = key(
        20000.0, between(1, 65535), "counts over baseline at full_scale_depth_m"
    )
    full_scale_depth_m: float = key(0.005, between(1e-4, 0.05), "depth that reads as 1")
    threshold_sigmas: float = key(
        6.0, between(1, 100), "idle noise a reading must exceed to be a touch"
    )
    state_dir: str = key(
        "", doc="where the baseline is kept over restarts; empty: $STATE_DIRECTORY, or nowhere"
    )
    missing_modules: int = key(
        0, between(0, 65535), "estimates stay valid while at most so many modules are missing"
    )
    calibration: str = key(
        "", doc="what taxeld calibrate wrote, relative to this file; empty: none is used"
    )
    learn: bool = unwritten(default=True)  # sure estimates teach how each taxel responds


@dataclass(frozen=True, slots=True)
class SourceConfig:
    kind: str = key(check=one_of(*KINDS), doc=", ".join(KINDS))
    interface: str = key("socketcan", doc="kind can: socketcan, slcan, or any of python-can's")
    channel: str = key(
        "", doc="can0, or the device of an adapter or a hub; its line speed may follow: …@921600"
    )
    bitrate: int = key(1_000_000, one_of(*BITRATES), "bit/s of the CAN bus")
    endpoint: str = key("", doc="kind array: PUB endpoint of its sender")
    array: str = key("", doc="kind array: the id that is heard; empty: the first that comes")
    period_ms: int = key(50, between(1, 65535), "scan period asked of the skin")
    listen_only: bool = key(False, doc="never send: for a skin that something else started")
    modules: tuple[tuple[int, ...], ...] = key(
        (),
        modules_fault,
        "[SUI, mask] of each module in its hub's order, where no DECLARE is heard",
    )

    @property
    def where(self) -> str:
        """An endpoint or a device: where frames of this kind come from."""
        return self.endpoint if self.kind == "array" else self.channel

    @property
    def is_unstamped(self) -> bool:
        """Whether what comes is dated when it is read: neither sender nor kernel stamps it."""
        return self.kind == "serial" or (self.kind == "can" and self.interface != "socketcan")


@dataclass(frozen=True, slots=True)
class SceneConfig:
    bundle: str = key("", doc="the object: a shipped bundle's name, or a path; empty: none")
    bundles: tuple[str, ...] = key(
        (), _bundles, "in place of bundle: the objects that it may be, by name or path"
    )

    @property
    def names(self) -> tuple[str, ...]:
        """The bundles of all objects that it may be."""
        return self.bundles or ((self.bundle,) if self.bundle else ())


@dataclass(frozen=True, slots=True)
class SensorPoseConfig:
    endpoint: str = key("", doc="SUB endpoint of the robot; empty: the sensor stands still")
    wait_s: float = key(
        0.02, between(0, 1), "a scan waits so long for a pose that tells where the sensor was"
    )
    sigma_m: float = key(
        0.001, between(0, 0.05), "sd of the sensor's place, the same throughout a touch"
    )


@dataclass(frozen=True, slots=True)
class LinkPoseConfig:
    topic: str = key(SENSOR_POSE, doc="the robot's topic for this link")


@dataclass(frozen=True, slots=True)
class LinkConfig(SkinConfig):
    """`[[skin]]`: the skin of one of several links, which touch the same object."""

    name: str = key("", doc="of the link; empty: link1, link2, …")
    source: SourceConfig | None = None  # None: that of [source]
    sensor_pose: LinkPoseConfig = field(default_factory=LinkPoseConfig)


@dataclass(frozen=True, slots=True)
class LoopConfig:
    rate_hz: float = key(
        100.0,
        between(1, 1000),
        "1 / rate_hz is the longest time between two passes while something is under way",
    )
    priority: int = key(
        20, between(0, 99), "SCHED_FIFO, and memory locked, where permitted; 0: neither"
    )


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """`[filter]`: the belief and what it learns from."""

    particles: int = key(100, between(2, 100_000), "N, at least")
    particles_max: int = key(400, between(2, 100_000), "N while the belief is wide, at most")
    injected: int = key(50, between(0, 10_000), "S, samples a touch brings")
    proposal: str = key("auto", doc="where they come from; auto: the bundle's first that is fast")
    injection: str = key(
        "mixture",
        one_of("mixture", "paper"),
        "mixture: weighed against all that is remembered; paper: by its Algorithm 1",
    )
    motion: str = key("none", one_of("none", "push"), "push: the object gives way")
    nudge_m: float = key(0.001, between(0, 0.05), "sd of what the object gives way at a touch")
    seed: int = key(0, between(0, 2**63), "of the one random generator")
    centre_m: tuple[float, float] = key((0.0, 0.0), doc="of the square the object may be in")
    half_width_m: float = key(0.5, between(0.01, 100), "of that square, world frame")
    within_m: float = key(
        0.01, between(0.001, 0.1), "p of an estimate: how likely its pose is this near the true one"
    )
    risk: float = key(1e-3, between(1e-6, 0.5), "of being farther from it than radius_m, at most")
    # a soft skin's readings differ by this much from expected ones (docs/physics.md);
    # a calibration has its own figures
    noise_sigma: float = unwritten(0.04)  # sd of an activation
    gain_cv: float = unwritten(0.17)  # spread of the taxels' gains


@dataclass(frozen=True, slots=True)
class PublishConfig:
    rate_hz: float = key(
        20.0, between(0.1, 1000), "estimates a second while no scan brings one, at least"
    )
    endpoints: tuple[str, ...] = key(("ipc:///run/taxeld/stream",), doc="XPUB endpoints, ipc alone")
    counts: bool = key(False, doc="whether the taxels' counts are published as well")


@dataclass(frozen=True, slots=True)
class ControlConfig:
    endpoint: str = key(
        "ipc:///run/taxeld/control", doc="answers REQ clients, ipc alone; empty: none"
    )


@dataclass(frozen=True, slots=True)
class RelayConfig:
    """`[relay]`: the streams over TCP."""

    publish: tuple[str, ...] = key((), doc="where they are published; [] is nowhere")
    control: str = key("", doc="where status, info and memory are answered; empty: nowhere")
    change: bool = key(False, doc="tare, reset and prior are taken there as well")


@dataclass(frozen=True, slots=True)
class CurveConfig:
    directory: str = key("", doc="keys, without which nothing goes beyond this machine")


@dataclass(frozen=True, slots=True)
class LogConfig:
    level: str = key("info", one_of(*LEVELS), "what is logged on standard error")


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """A whole configuration, table by table. With several links the first one stands in `skin` and
    `source` as well."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    source: SourceConfig
    skin: SkinConfig = field(default_factory=SkinConfig)
    sensor_pose: SensorPoseConfig = field(default_factory=SensorPoseConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    publish: PublishConfig = field(default_factory=PublishConfig)
    control: ControlConfig = field(default_factory=ControlConfig)
    relay: RelayConfig = field(default_factory=RelayConfig)
    curve: CurveConfig = field(default_factory=CurveConfig)
    log: LogConfig = field(default_factory=LogConfig)
    links: tuple[LinkConfig, ...] = unwritten(())
    is_sized: bool = unwritten(default=False)  # whether the file gives any of SIZES

    def of_link(self, number: int) -> "Config":
        """The configuration as if this link were the only one."""
        if not self.links:
            return self
        link = self.links[number]
        return replace(self, skin=link, source=link.source or self.source, links=())

    @property
    def each(self) -> "list[Config]":
        """The configuration of each link, as if it were the only one."""
        return [self.of_link(k) for k in range(len(self.names))]

    @property
    def served(self) -> list[tuple[str, str]]:
        """Each endpoint that is served, after its key."""
        named = {
            "publish.endpoints": self.publish.endpoints,
            "control.endpoint": (self.control.endpoint,),
            "relay.publish": self.relay.publish,
            "relay.control": (self.relay.control,),
        }
        return [(key, each) for key, endpoints in named.items() for each in endpoints if each]

    @property
    def names(self) -> tuple[str, ...]:
        """The links' names; one without a name where there is one skin."""
        return tuple(link.name for link in self.links) or ("",)

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of the links' sensor poses; empty: there is one skin, and its topic."""
        return tuple(link.sensor_pose.topic for link in self.links)

    @property
    def buses(self) -> list[tuple[SourceConfig, list[int]]]:
        """Each source with the numbers of the links on it, that of the first link first."""
        found: list[tuple[SourceConfig, list[int]]] = []
        for k, one in enumerate(self.each):
            on_it = next((links for source, links in found if source == one.source), None)
            if on_it is None:
                found.append((one.source, [k]))
            else:
                on_it.append(k)
        return found
