"""A configuration with a calibration's values, and the report on that calibration."""

from dataclasses import replace
from typing import Any

from taxeld.config.tables import Config, FilterConfig
from taxeld.pipeline.calibration_check import CalibrationDoubt
from taxeld.skin.calibration import DAY_S, Calibration


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


def told(calibration: Calibration | None, doubt: CalibrationDoubt, now: float) -> dict[str, Any]:
    """The calibration's part of health: whether one is in use, its age at the Unix time `now`, and
    the doubt that touches raise about it, or about the configured values in its place."""
    return {
        "used": calibration is not None,
        "age_s": 0.0 if calibration is None else calibration.age_days(now) * DAY_S,
        "suspect": int(doubt.suspect),
        "scale": doubt.scale,
        "mount_x_m": doubt.mount_x_m,
        "mount_y_m": doubt.mount_y_m,
        "mount_yaw_rad": doubt.mount_yaw_rad,
    }
