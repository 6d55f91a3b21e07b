"""Touches of the object before the first real one, to load code and memory, and to find out which
samples a touch has time for."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import AdviceConfig, Config
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.believing import Believing
from taxeld.proposals.ladder import ClockNs, Ladder

TOUCHES = 5  # touches on each rung; the first of all are slow, because their code is cold


def warm_up(
    config: Config,
    objects: Sequence[ObservationModel],
    ladder: Ladder,
    cpu: ClockNs,
    limit_ns: float,
) -> None:
    """Let another belief in the same objects take a few touches of the first. Where most of them
    take longer than `limit_ns` on the clock `cpu`, the ladder begins a rung lower, and so on."""
    rng, model = np.random.default_rng(0), objects[0]
    radius_m, depth_m = model.layout.radius_m, model.depth_max_m
    poses = contacts.synthesise(model.scene, radius_m, depth_m, 8 * TOUCHES, rng).pose[:TOUCHES]
    subject = Believing(replace(config, advice=AdviceConfig()), objects, ladder)
    while np.median(_costs_ns(subject, model, poses, cpu)) > limit_ns and not ladder.is_lowest:
        ladder.step_down()
        ladder.first += 1
    ladder.spent_ns = 0


def _costs_ns(subject: Believing, model: ObservationModel, poses: Poses, cpu: ClockNs) -> list[int]:
    """The time of the costliest scan of a touch of the object at each of poses (N, 3) in the sensor
    frame: N times [ns]."""
    costs, live = list[int](), np.ones(len(model.layout), dtype=np.bool_)
    subject.reset()
    for k, pose in enumerate(poses):
        pressed = model.activation(pose[None])[0]
        silent, spent = 0.0 * pressed, list[int]()
        for after_s, z in ((0.0, pressed), (0.05, pressed), (0.1, silent), (0.5, silent)):
            start = cpu()
            subject.on_scan(Activation(k + after_s, z, live), se2.inverse(pose), 0)
            spent.append(cpu() - start)
            subject.settle()
        costs.append(max(spent))
    return costs
