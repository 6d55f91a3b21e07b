"""The skin of most tests, what its hub has of it, and a calibration."""

from dataclasses import replace

import numpy as np

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.skin.calibration import Calibration, skin_digest
from taxeld_protocol.modules import wired

SPEC = SkinConfig().layout
SKIN = layouts.load(SPEC)
MODULES = wired(SKIN.uid.tolist())
LISTED = tuple((module.sui or 0, module.mask) for module in MODULES)
CALIBRATED_S = 1_760_000_000.0
CHANNELS = sum(module.channels for module in MODULES)


def table_of(layout: Layout, *, uid: bool = False) -> str:
    """A layout as a plain table, with the taxels' UIDs or without."""
    rows = zip(layout.position_m, layout.normal, layout.uid, strict=True)
    lines = [
        ",".join([*(f"{v:.6f}" for v in (*place, *normal)), *([str(own)] if uid else [])])
        for place, normal, own in rows
    ]
    return "\n".join([f"x,y,z,nx,ny,nz{',uid' * uid}", *lines, ""])


def calibration_of(skin: Layout, **changed: object) -> Calibration:
    """A calibration of a skin, with some values changed."""
    rng, taxels = np.random.default_rng(0), len(skin)
    usual = Calibration(
        t=CALIBRATED_S,
        digest=skin_digest(skin),
        object="box",
        presses=20,
        full_scale_depth_m=0.005,
        full_scale_counts=18_432.1,
        full_scale_sd=0.02,
        bend=0.061,
        bend_sd=0.03,
        mount=np.array([0.0012, -0.0007, 0.031]),
        mount_sd=np.array([1e-4, 1e-4, 2e-3]),
        noise_sigma=0.045,
        gain_cv=0.11,
        gain=np.exp(0.15 * rng.standard_normal(taxels)),
        gain_sd=rng.uniform(0.01, 0.17, taxels),
        onset=rng.standard_normal(taxels),
        onset_sd=rng.uniform(0.1, 0.8, taxels),
        noise_counts=rng.uniform(5, 90, taxels),
        frozen=np.arange(taxels) == 7,
        answers=rng.uniform(0.1, 1.0, taxels),
    )
    return replace(usual, **changed)  # type: ignore[arg-type]
