"""What a calibration would tell of a simulated skin."""

import numpy as np

from taxeld.skin.calibration import Calibration
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.world import World

# (noise_sigma, gain_cv) that calibrations of these foams find; the mean of two runs each
LEFT = {
    "scene": (0.02, 0.02),
    "typical": (0.058, 0.08),
    "poor": (0.058, 0.09),
    "stiff": (0.028, 0.08),
}


def calibration_of(world: World, given: Conditions, link: int) -> Calibration:
    """Of the very skin of a link, as exact as one can be."""
    skin, zeros = world.skins[link], np.zeros(len(world.links[link].layout))
    noise_sigma, gain_cv = LEFT[given.foam]
    return Calibration(
        t=0.0,
        digest="",
        object="",
        presses=0,
        full_scale_depth_m=world.links[link].depth_max_m,
        full_scale_counts=given.full_scale_counts,
        full_scale_sd=0.0,
        bend=given.skin.bend,
        bend_sd=0.0,
        mount=np.zeros(3),
        mount_sd=np.zeros(3),
        noise_sigma=noise_sigma,
        gain_cv=gain_cv,
        gain=skin.full_scale / given.full_scale_counts,
        gain_sd=zeros,
        onset=skin.response.steeper,
        onset_sd=zeros,
        noise_counts=given.skin.noise_counts[0] + zeros,
        frozen=zeros > 0.0,
    )
