"""Scenarios: what is touched, how, and by what skin (TOML)."""

from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from taxeld import toml_tables
from taxeld.config import SkinConfig
from taxeld.errors import SetupError
from taxeld.toml_tables import between, key, one_of
from taxeld_hil.physics import MeshConfig


@dataclass(frozen=True, slots=True)
class Scenario:
    bundle: str = key(doc="the object, as a bundle that the daemon can load")
    layout: str = key(SkinConfig().layout, doc="the skin")
    contacts: int = key(8, between(1, 1000), "presses, spread around the object")
    press_min_m: float = key(0.002, between(0.0005, 0.005), "least depth of a press")
    press_max_m: float = key(0.0045, between(0.0005, 0.005), "most")
    place_m: float = key(0.15, between(0.0, 10.0), "the object stands within ± this, any yaw")
    baseline_counts: float = key(10_000.0, between(100, 40_000), "idle reading")
    baseline_spread: float = key(500.0, between(0, 10_000), "sd between taxels")
    noise_counts: float = key(34.0, between(0, 1000), "sd of a reading")
    gain_cv: float = key(0.17, between(0, 1), "spread of the taxels' gains")
    full_scale_counts: float = key(20_000.0, between(100, 60_000), "counts of a 5 mm press")
    physics: str = key(
        "scene", one_of("scene", "mesh"), "what is felt: the estimator's own model, or [mesh]"
    )
    mesh: MeshConfig = field(default_factory=MeshConfig)


def load(name: str) -> Scenario:
    """A shipped scenario's name, or a path.

    Raises:
        SetupError: no such scenario, or faults in it.
    """
    shipped = Path(str(resources.files("taxeld_hil") / "scenarios"))
    for path in (shipped / f"{name}.toml", Path(name)):
        if path.is_file():
            return toml_tables.parse(Scenario, path.read_text(encoding="utf-8"), str(path))
    names = ", ".join(sorted(path.stem for path in shipped.glob("*.toml")))
    raise SetupError(f"no scenario '{name}'; shipped are {names}, or give a TOML file")
