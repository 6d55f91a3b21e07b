"""Touches of the object before the first real one, to load code and memory."""

from collections.abc import Sequence

import numpy as np

from taxeld.config.tables import Config
from taxeld.model import contacts, se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.pipeline.pipeline import estimator_of
from taxeld.proposals.samples import Samples

TOUCHES = 5


def warm_up(config: Config, objects: Sequence[ObservationModel], samples: Samples) -> None:
    """Let another belief in the same objects take a few touches of the first."""
    rng, model = np.random.default_rng(0), objects[0]
    radius_m, depth_m = model.layout.radius_m, model.depth_max_m
    poses = contacts.synthesise(model.scene, radius_m, depth_m, 8 * TOUCHES, rng).pose[:TOUCHES]
    subject = estimator_of(config, objects, samples)
    live = np.ones(len(model.layout), dtype=np.bool_)
    for k, pose in enumerate(poses):
        pressed = model.activation(pose[None])[0]
        silent = 0.0 * pressed
        for after_s, z in ((0.0, pressed), (0.05, pressed), (0.1, silent), (0.5, silent)):
            subject.on_scan(Activation(k + after_s, z, live), se2.inverse(pose))
