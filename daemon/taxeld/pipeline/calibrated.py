"""A configuration with a calibration's values."""

from dataclasses import replace

from taxeld.config.tables import Config
from taxeld.skin.calibration import Calibration


def calibrated(config: Config, calibration: Calibration | None) -> Config:
    """The configuration with measured values: full scale, and the filter's noise and gain
    spread."""
    if calibration is None:
        return config
    c = calibration
    return replace(
        config,
        skin=replace(config.skin, full_scale_counts=c.full_scale_counts),
        filter=replace(config.filter, noise_sigma=c.noise_sigma, gain_cv=c.gain_cv),
    )
