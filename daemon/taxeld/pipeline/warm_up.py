"""Touches of the object before the first real one, to load code and memory."""

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimator import Estimator
from taxeld.model import contacts, se2
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.proposals.ladder import Ladder

TOUCHES = 5


def warm_up(model: ObservationModel, ladder: Ladder, config: FilterConfig) -> None:
    """Let another estimator take a few touches; then the ladder knows the cost of a touch."""
    rng = np.random.default_rng(0)
    radius_m, depth_m = model.layout.radius_m, model.depth_max_m
    poses = contacts.synthesise(model.scene, radius_m, depth_m, 8 * TOUCHES, rng).pose
    subject = Estimator(model, ladder, config)
    live = np.ones(len(model.layout), dtype=np.bool_)
    for k, pose in enumerate(poses[:TOUCHES]):
        pressed = model.activation(pose[None])[0]
        silent = 0.0 * pressed
        for after_s, z in ((0.0, pressed), (0.05, pressed), (0.1, silent), (0.5, silent)):
            subject.on_scan(Activation(k + after_s, z, live), se2.inverse(pose))
            ladder.used()
    ladder.settle()
