"""Where an experiment takes place: an object on a skin, and how the two stand to each other."""

from dataclasses import dataclass
from pathlib import Path

from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld_training.objects import defaults, meshes, scenes

DEPTH_MAX_M, HEIGHT_M = defaults.DEPTH_MAX_M, defaults.HEIGHT_M
OBJECTS = (  # the paper's
    "002_master_chef_can", "003_cracker_box", "006_mustard_bottle", "016_pear", "019_pitcher_base",
    "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "061_foam_brick",
)  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """An object on a skin, and how models for it are trained."""

    object: str
    skin: str  # a layout, as `skin.layout` has it
    columns: int  # of a generated cylinder; 0 for another layout
    updates: float = 1.0  # share of a model's own
    seed: int = 0

    @property
    def name(self) -> str:
        return f"{Path(self.object).stem}-{self.columns or Path(self.skin).stem}"

    @property
    def is_as_shipped(self) -> bool:
        """Whether a shipped bundle may be of it."""
        return True

    def model(self) -> ObservationModel:
        skin = layouts.load(self.skin)
        mesh = meshes.load(meshes.find(self.object)[0])
        return ObservationModel(scenes.build(mesh, skin, HEIGHT_M), skin, DEPTH_MAX_M)


@dataclass(frozen=True)
class Sized(Setting):
    """An object made larger or smaller, and touched at a height as much higher or lower, on a skin
    of another full scale."""

    scale: float = 1.0
    depth_max_m: float = DEPTH_MAX_M

    @property
    def name(self) -> str:
        size = f"x{self.scale:.4g}" if self.scale != 1.0 else ""
        depth = f"deep{1e3 * self.depth_max_m:g}" if self.depth_max_m != DEPTH_MAX_M else ""
        skin = self.skin.replace(":", "-").replace(",", "-").replace("=", "")
        return "-".join(part for part in (Path(self.object).stem, size, depth, skin) if part)

    @property
    def is_as_shipped(self) -> bool:
        return self.scale == 1.0 and self.depth_max_m == DEPTH_MAX_M

    def model(self) -> ObservationModel:
        skin = layouts.load(self.skin)
        mesh = meshes.load(meshes.find(self.object)[0])
        mesh.apply_scale(self.scale)
        scene = scenes.build(mesh, skin, self.scale * HEIGHT_M)
        return ObservationModel(scene, skin, self.depth_max_m)


def ring(columns: int, radius_m: float = 0.04, pitch_m: float = 0.015) -> str:
    """A skin of 5 rows; the paper's."""
    return f"cylinder:rows=5,columns={columns},radius_m={radius_m:g},pitch_m={pitch_m:g}"
