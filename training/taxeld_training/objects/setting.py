"""Where an experiment takes place: an object on a skin, and how the two stand to each other."""

import re
from dataclasses import dataclass
from pathlib import Path

from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld_hil.objects import HEIGHT_M, meshes, scenes
from taxeld_training.objects import DEPTH_MAX_M

OBJECTS = (  # the paper's ten
    "002_master_chef_can",
    "003_cracker_box",
    "006_mustard_bottle",
    "016_pear",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "061_foam_brick",
)


@dataclass(frozen=True)
class Setting:
    """An object on a skin, and how models for it are trained."""

    object: str
    skin: str  # a layout, as `skin.layout` has it
    columns: int  # columns of a generated ring; 0 for another layout
    updates: float = 1.0  # share of a model's own number of updates
    seed: int = 0
    scale: float = 1.0  # factor of the object, and of the height at which it is touched
    depth_max_m: float = DEPTH_MAX_M  # depth of a press at the skin's full scale

    @property
    def name(self) -> str:
        """For files: other settings of one experiment have other names."""
        skin = self.skin if self.skin.startswith("cylinder:") else Path(self.skin).stem
        parts = [Path(self.object).stem, str(self.columns or re.sub("[:,=]", "-", skin))]
        if self.scale != 1.0:
            parts.append(f"x{self.scale:.4g}")
        if self.depth_max_m != DEPTH_MAX_M:
            parts.append(f"deep{1e3 * self.depth_max_m:g}")
        return "-".join(parts)

    @property
    def is_as_shipped(self) -> bool:
        """Whether a shipped bundle may be of it."""
        return self.scale == 1.0 and self.depth_max_m == DEPTH_MAX_M

    def model(self) -> ObservationModel:
        """The object's scene on the skin.

        Raises:
            SetupError: no such object or layout, or the skin misses the object.
        """
        skin = layouts.load(self.skin)
        mesh = meshes.load(meshes.find(self.object)[0])
        if self.scale != 1.0:
            mesh.apply_scale(self.scale)
        scene = scenes.build(mesh, skin, self.scale * HEIGHT_M)
        return ObservationModel(scene, skin, self.depth_max_m)


def ring(columns: int, radius_m: float = 0.04, pitch_m: float = 0.015) -> str:
    """A skin of 5 rows; the paper's."""
    return f"cylinder:rows=5,columns={columns},radius_m={radius_m:g},pitch_m={pitch_m:g}"
