"""A configuration with a calibration's values."""

from dataclasses import replace
from typing import Any

from taxeld.config.tables import Config, FilterConfig
from taxeld.skin.calibration import Calibration


def calibrated(config: Config, calibration: Calibration | None) -> Config:
    """The configuration with measured values in place of defaults: full scale, and the filter's
    noise and gain spread where the user has set no others."""
    if calibration is None:
        return config
    usual, own = FilterConfig(), config.filter
    measured: dict[str, Any] = {}
    if own.noise_sigma == usual.noise_sigma:
        measured["noise_sigma"] = calibration.noise_sigma
    if own.gain_cv == usual.gain_cv:
        measured["gain_cv"] = calibration.gain_cv
    skin = replace(config.skin, full_scale_counts=calibration.full_scale_counts)
    return replace(config, skin=skin, filter=replace(own, **measured))
