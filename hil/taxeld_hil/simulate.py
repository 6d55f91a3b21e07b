"""A scenario on a fake clock: the same wire, decoder and pipeline as the daemon, in no time.

Deterministic for a seed, so tests and experiments can ask it what the real-time run only suggests.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from taxeld import bundle, layout, toml_tables
from taxeld.config import Config
from taxeld.estimate import Estimate
from taxeld.pipeline import Pipeline
from taxeld.poses import PoseTrack
from taxeld.se2 import Poses
from taxeld.symmetry import add_m
from taxeld_hil import robot
from taxeld_hil.scenario import Scenario
from taxeld_hil.world import world as world_of
from taxeld_protocol import cyskin
from taxeld_protocol.decoder import Decoder
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb

SCAN_PERIOD_S = 0.05
POSE_PERIOD_S = 0.01
IDLE_S = 1.5


class Step(NamedTuple):
    """An estimate of a scan, with its error."""

    estimate: Estimate
    error_mm: float  # symmetry-aware ADD of the MAP


@dataclass(frozen=True, slots=True)
class Simulation:
    """A scenario on the fake clock; `config` sets what the daemon would be configured with."""

    scenario: Scenario
    seed: int
    config: Config

    def steps(self) -> Iterator[Step]:
        """One step a scan, from the first to the last of the robot's path."""
        scenario = self.scenario
        skin = layout.load(scenario.layout)
        loaded = bundle.load(scenario.bundle, skin, self.config.skin.full_scale_depth_m)
        modules = wired(skin.uid.tolist())
        world = world_of(scenario, loaded.model, modules, self.seed)
        path = robot.plan(scenario, loaded.model, world.truth, self.seed)
        ihb = VirtualIhb(modules)
        decoder = Decoder(lambda _: modules)
        pipeline = Pipeline(self.config, skin, loaded)
        for tick in range(int((path.duration_s + IDLE_S) / POSE_PERIOD_S)):
            t = tick * POSE_PERIOD_S
            pose = path.at(t - IDLE_S)
            _add_pose(pipeline, t, pose)
            if tick % round(SCAN_PERIOD_S / POSE_PERIOD_S):
                continue
            for command, payload in ihb.sensor_data(world.counts(pose, t)):
                for frame in cyskin.to_frames(command, payload, ihb=ihb.short_id, t=t):
                    for scan in decoder.feed(frame)[1]:
                        estimate = pipeline.on_scan(scan).estimate
                        yield Step(
                            estimate,
                            1e3 * add_m(loaded.model.scene, estimate.map, world.truth)[1],
                        )


def configured(scenario: Scenario, seed: int, text: str = "") -> Config:
    """The configuration of a simulated daemon; `text` is TOML that adds to or replaces defaults."""
    base = f'[source]\nkind = "replay"\npath = "."\n[scene]\nbundle = "{scenario.bundle}"\n'
    config = toml_tables.parse(Config, base + text, "simulation")
    return replace(
        config,
        skin=replace(
            config.skin, layout=scenario.layout, full_scale_counts=scenario.full_scale_counts
        ),
        sensor_pose=replace(config.sensor_pose, endpoint="inproc://robot"),
        filter=replace(config.filter, seed=seed),
    )


def _add_pose(pipeline: Pipeline, t: float, pose: Poses) -> None:
    if isinstance(pipeline.poses, PoseTrack):
        x, y, theta = (float(v) for v in pose)
        pipeline.poses.add(t, x, y, theta)


def error_by_contact(steps: Iterator[Step]) -> list[float]:
    """The error at the end of each contact [mm]."""
    errors: list[float] = []
    before = False
    for step in steps:
        if before and not step.estimate.contact:
            errors.append(step.error_mm)
        before = step.estimate.contact
    return errors if np.isfinite(errors).all() else []
