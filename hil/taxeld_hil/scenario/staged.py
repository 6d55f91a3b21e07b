"""The simulated world that a scenario asks for."""

from taxeld.config.tables import SkinConfig
from taxeld.model.observation import ObservationModel
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.array import Group
from taxeld_protocol.modules import Module
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject, model_of
from taxeld_sim.world.world import World, planned_world


def world_of(scenario: Scenario, seed: int) -> World:
    """The world of a scenario. Raises SetupError as `planned_world`."""
    specs = [scenario.of_link(k).skin_layout for k in range(scenario.links)]
    subject, given = Subject(scenario.bundle), conditions_of(scenario)
    kind = Group if scenario.transport == "array" else Module
    guide = "advised" if scenario.advised else "around"
    return planned_world(subject, specs, given, guide, scenario.contacts, seed, kind)


def conditions_of(scenario: Scenario) -> Conditions:
    """What differs in a scenario's world from the usual one."""
    full_m = SkinConfig().full_scale_depth_m
    return Conditions(
        foam=scenario.physics,
        keys=tuple(scenario.mesh.keys.items()),
        baseline_counts=scenario.baseline_counts,
        baseline_spread=scenario.baseline_spread,
        full_scale_counts=scenario.full_scale_counts,
        press=(scenario.press_min_m / full_m, scenario.press_max_m / full_m),
        hold_s=scenario.hold_s,
        robot_m=scenario.robot_m,
        robot_told=True,
        place_m=scenario.place_m,
    )


def load_model(scenario: Scenario) -> ObservationModel:
    """The skin and the object of a scenario, as the daemon has them. Raises SetupError."""
    return model_of(Subject(scenario.bundle), scenario.skin_layout)
