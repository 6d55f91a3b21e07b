"""The conditions of a simulated world: one table for scenarios, `expect` and all experiments."""

from dataclasses import dataclass, fields, replace
from typing import Any

from taxeld.config.tables import SensorPoseConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld_sim.world.mesh_config import FOAMS, PLAIN, SKINS, MeshConfig


@dataclass(frozen=True)
class Conditions:
    """How skin, robot and object behave. The defaults are what the estimator assumes."""

    # the skin
    foam: str = "scene"  # of FOAMS; `scene` reads exactly what the estimator expects
    keys: tuple[tuple[str, Any], ...] = ()  # of MeshConfig, in place of the foam's own
    dead_share: float = 0.0  # share of scattered taxels that never answer
    dead_modules: int = 0  # modules that never answer
    answers: float = 1.0  # mean share of presses that a taxel answers; each has a share of its own
    stuck: int = 0  # taxels that read the same from the first touch on
    stuck_at: float = 1.0  # what they read, in full scales
    drift: float = 0.0  # of each taxel's baseline, up or down at most [full scales a minute]
    baseline_counts: float = 10_247.0  # idle reading
    baseline_spread: float = 286.0  # sd between taxels [counts]
    full_scale_counts: float = SkinConfig().full_scale_counts  # of a full press
    calibrated: bool = False  # whether the filter is told how each taxel responds
    # the touches
    press: tuple[float, float] = (0.0, 1.0)  # least and most depth, in depths at full scale
    hold_s: float = 0.3  # how long a press is held
    slip_m: float = 0.0  # sd of the sensor's place in each scan meanwhile
    one_side: bool = False  # all touches come from one quarter of the directions
    # the robot
    robot_m: float = SensorPoseConfig().sigma_m  # sd of its error in x and in y, for each touch
    robot_rad: float = 0.0  # sd of its error in yaw, for each touch
    lean_rad: float = 0.0  # of each touch's link from the upright, in a random direction
    robot_told: bool = False  # whether the filter is told of `robot_m`
    # the object
    place_m: float = 0.15  # it stands within ± this of the origin, at any yaw
    kidnapped_after: int = 0  # touches after which it is put elsewhere; 0: never
    moved_m: float = 0.0  # its way between two touches, all along one line
    moved_rad: float = 0.0  # its turn between two touches
    nudged_m: float = 0.0  # about how far each press moves it away from the skin
    both: int = 0  # touches that also press a second object of the same kind beside it

    def __post_init__(self) -> None:
        """Raises SetupError where there is no such foam, or a foam has no such key."""
        if self.foam not in FOAMS:
            foams = ", ".join(FOAMS)
            raise SetupError(f"no foam '{self.foam}'; there are {foams}; a layout is --layout")
        known = [field.name for field in fields(MeshConfig)]
        for name, _ in self.keys:
            if name not in known:
                raise SetupError(f"no key '{name}' of a foam; there are {', '.join(known)}")

    @property
    def skin(self) -> MeshConfig:
        """The foam with `keys`. Of `scene`, gains and noise alone are used."""
        return replace(SKINS.get(self.foam, PLAIN), **dict(self.keys))

    @property
    def is_exact(self) -> bool:
        """Whether the estimator's own model says how deep each taxel is pressed."""
        return self.foam == "scene"
