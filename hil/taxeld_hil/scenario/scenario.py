"""Scenarios (TOML): what is touched, how, by what skin, what fails, and what is expected of it.

Times are scenario times: seconds from the first scan.
"""

from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path

from taxeld.config import gate
from taxeld.config.file import text_of
from taxeld.config.gate import Given, between, key, one_of
from taxeld.config.tables import LINKS_MAX
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle as bundles
from taxeld_protocol.modules import MAX_MODULES, NAMES
from taxeld_sim.world.mesh_config import FOAMS, PLAIN, SKINS, MeshConfig

TRANSPORTS = ("slcan", "native", "can", "array")

SKIN_KINDS = ("module_dead", "taxel_stuck", "saturated", "baseline_jump")
# of frames or lines on their way: an array has neither
OF_FRAMES = (
    "dropped",
    "duplicated",
    "reordered",
    "corrupted",
    "late",
    "flooded",
    "adapter_closed",
)
KINDS = (
    *OF_FRAMES,
    *SKIN_KINDS,
    "reboot",
    "unplugged",
    "pose_silent",
    "pose_frozen",
    "pose_late",
    "pose_jumping",
    "daemon_killed",
)


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that fails for a while; keys that its kind does not need are ignored."""

    kind: str = key(check=one_of(*KINDS), doc="what fails")
    at_s: float = key(check=between(0, 1e6), doc="when it begins")
    for_s: float = key(1.0, between(0, 1e6), "how long it lasts")
    share: float = key(0.1, between(0, 1), "of the frames or poses that it hits")
    delay_s: float = key(0.1, between(0, 10), "late, pose_late: by so much")
    per_s: float = key(2000.0, between(1, 20_000), "flooded: foreign frames a second")
    module: int = key(0, between(0, 247), "module_dead, baseline_jump: which")
    taxels: tuple[int, ...] = key((), doc="taxel_stuck, saturated: which; empty: of the module")
    counts: float = key(3000.0, between(-40_000, 40_000), "baseline_jump: by so much")
    offset_m: float = key(2.0, between(0, 100), "pose_jumping: how far off")
    link: int = key(0, between(0, LINKS_MAX - 1), "of several links: which")

    @property
    def end_s(self) -> float:
        return self.at_s + self.for_s


@dataclass(frozen=True, slots=True)
class Expect:
    """Bounds that a run is graded by."""

    error_mm: float = key(10.0, between(0, 1000), "symmetry-aware ADD at the end, under this")
    recovery_s: float = key(2.0, between(0, 60), "fresh estimates again so soon after a fault")
    found: bool = key(True, doc="whether the object must be found in the end")


@dataclass(frozen=True, slots=True)
class Scenario:
    bundle: str = key(doc="the object, as a bundle that the daemon can load")
    bundles: tuple[str, ...] = key((), doc="the objects that the daemon knows; empty: that one")
    layout: str = key("", doc="the skin; empty: the one that the bundle was built for")
    layouts: tuple[str, ...] = key((), doc="skins of several links, as `layout`; they take turns")
    one_bus: bool = key(default=False, doc="whether the hubs of several links are on one bus")
    transport: str = key("slcan", one_of(*TRANSPORTS), "how the skin is reached in simulation")
    advised: bool = key(False, doc="whether the robot follows the daemon's advice instead")
    contacts: int = key(8, between(1, 1000), "presses, spread around the object")
    press_min_m: float = key(0.002, between(0.0005, 0.005), "least depth of a press, of 5 mm foam")
    press_max_m: float = key(0.0045, between(0.0005, 0.005), "most")
    hold_s: float = key(0.3, between(0, 3600), "how long a press is held")
    rest_s: float = key(0.5, between(0.5, 3600), "at the end, untouched")
    robot_m: float = key(0.0, between(0, 0.05), "sd of the robot's error, drawn for each touch")
    place_m: float = key(0.15, between(0.0, 10.0), "the object stands within ± this, any yaw")
    baseline_counts: float = key(10_247.0, between(100, 40_000), "idle reading")
    baseline_spread: float = key(286.0, between(0, 10_000), "sd between taxels")
    full_scale_counts: float = key(20_000.0, between(100, 60_000), "counts of a full press")
    physics: str = key(
        "typical", one_of(*FOAMS), "a soft skin, or the estimator's own model of one"
    )
    mesh: Given[MeshConfig] = field(default_factory=Given)  # keys that replace the skin's own
    expect: Expect = Expect()  # grounds of the grade
    fault: tuple[Fault, ...] = key((), doc="what fails, and when")

    @property
    def known(self) -> tuple[str, ...]:
        """The bundles that the daemon has."""
        return self.bundles or (self.bundle,)

    @property
    def links(self) -> int:
        """How many links have a skin."""
        return max(len(self.layouts), 1)

    def of_link(self, number: int) -> "Scenario":
        """The scenario of one of the links, with its share of the contacts."""
        if not self.layouts:
            return self
        return replace(
            self,
            layout=self.layouts[number],
            layouts=(),
            contacts=len(range(number, self.contacts, self.links)),
            fault=tuple(fault for fault in self.fault if fault.link == number),
        )

    def in_real_time(self) -> "Scenario":
        """The same scenario. Raises SetupError where it needs the fake clock."""
        if self.links > 1 or self.advised:
            what = "advised: such a robot runs" if self.advised else "layouts: several links run"
            raise SetupError(f"{what} on the fake clock alone: --clock fake")
        return self

    def check_links(self) -> None:
        """Raises SetupError where the links do not fit the scenario's other keys."""
        if any(fault.link >= self.links for fault in self.fault):
            raise SetupError(f"fault.link: the scenario has the links 0..{self.links - 1}")
        if self.links > self.contacts:
            raise SetupError(f"contacts: must be at least one for each of {self.links} links")
        if self.links > 1 and self.transport == "array":
            raise SetupError("transport: one link at most is an array; give several slcan")
        if self.links > 1 and self.one_bus and self.transport == "native":
            raise SetupError("transport: a native line has one hub; give one_bus slcan")

    @property
    def skin(self) -> MeshConfig:
        """The skin that `physics` names, with the scenario's own keys. Of `scene`, gains and noise
        alone are used."""
        return self.mesh.over(SKINS.get(self.physics, PLAIN))

    @property
    def skin_layout(self) -> str:
        """The layout of the skin.

        Raises:
            SetupError: it is a file that only the maker of the bundle had.
        """
        own = self.layout or next(iter(self.layouts), "")
        name = own or bundles.manifest_of(self.bundle).layout.name
        if own or ":" in name:  # the name of a generated one is its line
            return name
        raise SetupError(f"{self.bundle} was built for a layout file, {name}: name it by --layout")

    def on(self, foam: str, *layouts: str) -> "Scenario":
        """The same scenario on another foam and layout, or with a link for each of several; on its
        own where none is named. A layout whose UIDs no module can have comes as an array.

        Raises:
            SetupError: there is no foam of that name, or the layout cannot be read.
        """
        if foam and foam not in FOAMS:
            raise SetupError(
                f"no foam '{foam}'; there are {', '.join(FOAMS)}; a layout is given by --layout"
            )
        named = tuple(filter(None, layouts))
        skin = replace(self, physics=foam or self.physics)
        if len(named) > 1:
            return replace(skin, layouts=named)
        if named:
            skin = replace(skin, layout=named[0], layouts=())
        return skin if not skin.layout or _has_modules(skin.layout) else skin.over("array")

    def touching(self, bundle: str) -> "Scenario":
        """The same scenario with another object, which the daemon knows; with its own where none is
        named."""
        if not bundle:
            return self
        if not self.bundles or bundle in self.bundles:
            return replace(self, bundle=bundle)
        own = bundles.manifest_of(bundle).object
        others = (name for name in self.bundles if bundles.manifest_of(name).object != own)
        return replace(self, bundle=bundle, bundles=(*others, bundle))

    def over(self, transport: str) -> "Scenario":
        """The same scenario over one of TRANSPORTS; over its own where none is named."""
        return replace(self, transport=transport or self.transport)


def _has_modules(layout: str) -> bool:
    """Whether a hub can carry it: its taxels are T1, T2, … of few enough modules."""
    uid = layouts.read(layout).uid
    name = uid & 0xF
    return bool((name > 0).all() and (name < NAMES).all()) and len({*(uid >> 4)}) <= MAX_MODULES


def shipped() -> dict[str, Path]:
    """The shipped scenarios by name."""
    place = Path(str(resources.files("taxeld_hil") / "scenarios"))
    return {path.stem: path for path in sorted(place.glob("*.toml"))}


def load(name: str) -> Scenario:
    """A shipped scenario's name, or a path.

    Raises:
        SetupError: no such scenario, or faults in it.
    """
    for path in (shipped().get(name), Path(name)):
        if path is not None and path.is_file():
            return gate.parse(Scenario, text_of(path), str(path))
    names = ", ".join(shipped())
    raise SetupError(f"no scenario '{name}'; shipped are {names}, or give a TOML file")
