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

    def model(self) -> ObservationModel:
        skin = layouts.load(self.skin)
        mesh = meshes.load(meshes.find(self.object)[0])
        return ObservationModel(scenes.build(mesh, skin, HEIGHT_M), skin, DEPTH_MAX_M)


def ring(columns: int) -> str:
    """The paper's skin of 5 rows."""
    return f"cylinder:rows=5,columns={columns},radius_m=0.04,pitch_m=0.015"
