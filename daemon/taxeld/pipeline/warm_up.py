"""Touches of the object before the first real one, to load code and memory, and to find out which
samples a touch has time for."""

from collections.abc import Sequence

import numpy as np

from taxeld.arrays import Poses
from taxeld.config.tables import FilterConfig
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.calibration_check import CalibrationCheck
from taxeld.proposals.ladder import ClockNs, Ladder

TOUCHES = 5  # touches on each rung; the first of all are slow, because their code is cold


def warm_up(
    model: ObservationModel,
    ladder: Ladder,
    config: FilterConfig,
    cpu: ClockNs,
    limit_ns: float,
    more: Sequence[ObservationModel] = (),
) -> None:
    """Let another estimator of the same objects take a few touches of the first. Where most of them
    take longer than `limit_ns` on the clock `cpu`, the ladder begins a rung lower, and so on."""
    rng = np.random.default_rng(0)
    radius_m, depth_m = model.layout.radius_m, model.depth_max_m
    poses = contacts.synthesise(model.scene, radius_m, depth_m, 8 * TOUCHES, rng).pose[:TOUCHES]
    others = [Known(one, ladder.of(k), ladder.beside(one)) for k, one in enumerate(more, 1)]
    beside = ladder.beside(model)
    subject = Estimator(model, ladder, config, more=others, beside=beside)
    while np.median(_costs_ns(subject, poses, cpu)) > limit_ns and not ladder.is_lowest:
        ladder.step_down()
        ladder.first += 1
    ladder.spent_ns = 0


def _costs_ns(subject: Estimator, poses: Poses, cpu: ClockNs) -> list[int]:
    """The time of the costliest scan of a touch of the object at each of poses (N, 3) in the sensor
    frame: N times [ns]."""
    model, costs = subject.model, list[int]()
    live = np.ones(len(model.layout), dtype=np.bool_)
    subject.reset()
    check = CalibrationCheck(model, subject.config)
    for k, pose in enumerate(poses):
        pressed = model.activation(pose[None])[0]
        silent, spent = 0.0 * pressed, list[int]()
        for after_s, z in ((0.0, pressed), (0.05, pressed), (0.1, silent), (0.5, silent)):
            start, believed = cpu(), subject.estimate.modes
            subject.learn(Activation(k + after_s, z, live), se2.inverse(pose))
            check.on_scan(subject.used, believed, subject.estimate.contacts)
            spent.append(cpu() - start)
            check.step()
            subject.think()
            while subject.bank.is_behind:
                subject.think()
        costs.append(max(spent))
    return costs
