"""A calibration as a TOML file: written by `taxeld calibrate`, named by `skin.calibration`."""

import math
import time
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config.file import text_of
from taxeld.config.tables import Config, SkinConfig
from taxeld.config.toml_tables import ConfigError, between, key, parse
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.skin import state
from taxeld.skin.calibration import Calibration
from taxeld.source import session

VERSION = 1
MAX_AGE_DAYS = 180.0
FUTURE_DAYS = 1.0  # a clock that is set wrong; more is a wrong file


def _digest(text: str) -> str | None:
    return None if len(text) == 16 else "must be the 16 hex digits of a skin"


@dataclass(frozen=True, slots=True)
class MountTable:
    x_m: float = key(check=between(-1, 1))
    y_m: float = key(check=between(-1, 1))
    yaw_rad: float = key(check=between(-4, 4))
    x_sd_m: float = key(check=between(0, 1))
    y_sd_m: float = key(check=between(0, 1))
    yaw_sd_rad: float = key(check=between(0, 4))


@dataclass(frozen=True, slots=True)
class TaxelTable:
    uid: int = key(check=between(0, 1 << 40))
    gain: float = key(check=between(0.01, 100))
    gain_sd: float = key(check=between(0, 10))
    onset: float = key(check=between(-20, 20))
    onset_sd: float = key(check=between(0, 20))
    noise_counts: float = key(check=between(0, 65535))
    frozen: bool = key(False)


@dataclass(frozen=True, slots=True)
class CalibrationTable:
    mount: MountTable = field(metadata={"check": None, "doc": ""})
    version: int = key(check=between(1, 1_000_000))
    t: float = key(check=between(0, 1e11), doc="Unix seconds")
    date: str = key(doc="the same, for a reader")
    skin: str = key(check=_digest, doc="digest of the taxels' places and UIDs")
    object: str = key()
    presses: int = key(check=between(1, 1e6))
    full_scale_depth_m: float = key(check=between(1e-4, 0.05))
    full_scale_counts: float = key(check=between(1, 1e6))
    full_scale_sd: float = key(check=between(0, 10))
    bend: float = key(check=between(-2, 2))
    bend_sd: float = key(check=between(0, 10))
    noise_sigma: float = key(check=between(1e-4, 1))
    gain_cv: float = key(check=between(0, 1))
    taxel: tuple[TaxelTable, ...] = key()


def dump(c: Calibration, layout: Layout) -> str:
    """The file's text."""
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(c.t))
    name = c.object.replace("\\", "/").replace('"', "'")
    columns = ("gain", "gain_sd", "onset", "onset_sd", "noise_counts")
    rows = zip(layout.uid.tolist(), *(getattr(c, name) for name in columns), c.frozen, strict=True)
    taxels = "".join(
        f"  {{uid = {uid}, gain = {gain:.5f}, gain_sd = {gain_sd:.5f}, onset = {onset:.4f}, "
        f"onset_sd = {onset_sd:.4f}, noise_counts = {noise:.2f}, "
        f"frozen = {str(bool(frozen)).lower()}}},\n"
        for uid, gain, gain_sd, onset, onset_sd, noise, frozen in rows
    )
    (x, y, yaw), (x_sd, y_sd, yaw_sd) = c.mount, c.mount_sd
    return f"""\
# A taxeld calibration. Name it in the configuration: [skin] calibration = "THIS FILE"
# sd: one standard deviation; of full scale and gains relative.
version = {VERSION}
t = {c.t:.3f}
date = "{date}"
skin = "{c.digest}"
object = "{name}"
presses = {c.presses}
full_scale_depth_m = {c.full_scale_depth_m:.6g}
full_scale_counts = {c.full_scale_counts:.1f}
full_scale_sd = {c.full_scale_sd:.5f}
bend = {c.bend:.5f}
bend_sd = {c.bend_sd:.5f}
noise_sigma = {c.noise_sigma:.5f}
gain_cv = {c.gain_cv:.4f}
taxel = [
{taxels}]

[mount]  # of the sensor's frame in the frame that the robot tells of
x_m = {x:.6f}
y_m = {y:.6f}
yaw_rad = {yaw:.6f}
x_sd_m = {x_sd:.6f}
y_sd_m = {y_sd:.6f}
yaw_sd_rad = {yaw_sd:.6f}
"""


def read(path: Path, layout: Layout, full_scale_depth_m: float) -> Calibration:
    """The calibration of this very skin.

    Raises:
        SetupError: it is unreadable, damaged, or of another skin or depth.
    """
    try:
        table = parse(CalibrationTable, text_of(path), path.name)
    except ConfigError as error:
        first = error.faults[0].removeprefix(f"{path.name}: ").removeprefix(f"{path}: ")
        fault = first.replace("unreadable configuration", "unreadable").split("; name a")[0]
        fault += f"; {len(error.faults) - 1} more faults" if len(error.faults) > 1 else ""
    else:
        fault = _fault(table, layout, full_scale_depth_m)
    if fault:
        raise SetupError(
            f"skin.calibration: {path.name}: {fault}; calibrate this skin (taxeld calibrate), "
            "or name its own file"
        )
    return _calibration(table)


def _fault(table: CalibrationTable, layout: Layout, full_scale_depth_m: float) -> str:
    """Why the calibration is not of this skin; empty where it is."""
    own = state.digest(layout)
    if table.version != VERSION:
        return f"it is of version {table.version}, not {VERSION}"
    if table.skin != own or [t.uid for t in table.taxel] != layout.uid.tolist():
        return f"it is of another layout ({table.skin}), not of {layout.name} ({own})"
    if not math.isclose(table.full_scale_depth_m, full_scale_depth_m, rel_tol=1e-3):
        return (
            f"it is for skin.full_scale_depth_m = {table.full_scale_depth_m:g}, "
            f"not {full_scale_depth_m:g}"
        )
    return ""


def of(config: Config, layout: Layout) -> Calibration | None:
    """The configured calibration, now, or when the session that is replayed was recorded.

    Raises:
        SetupError: as `load`.
    """
    if config.source.kind != "replay" or not config.skin.calibration:
        return load(config.skin, layout, time.time())
    return load(config.skin, layout, session.begun(Path(config.source.path)), recorded=True)


def load(
    config: SkinConfig, layout: Layout, now: float, *, recorded: bool = False
) -> Calibration | None:
    """The configured calibration at a Unix time; None where none is named. What is `recorded` may
    be older than its calibration.

    Raises:
        SetupError: it cannot be used, or is too old.
    """
    if not config.calibration:
        return None
    path = Path(config.calibration)
    found = read(path, layout, config.full_scale_depth_m)
    age_days = found.age_days(now)
    if age_days > MAX_AGE_DAYS:
        raise SetupError(
            f"skin.calibration: {path.name}: it is {age_days:.0f} days old, more than "
            f"{MAX_AGE_DAYS:g}; calibrate the skin again (taxeld calibrate)"
        )
    if age_days < -FUTURE_DAYS and not recorded:
        raise SetupError(
            f"skin.calibration: {path.name}: it is from {-age_days:.0f} days ahead; set this "
            "machine's clock"
        )
    return found


def _calibration(table: CalibrationTable) -> Calibration:
    """The table with its taxels in columns."""
    mount, taxels = table.mount, table.taxel
    values: dict[str, Any] = {
        name: np.array([getattr(taxel, name) for taxel in taxels])
        for name in TaxelTable.__dataclass_fields__
        if name != "uid"
    }
    for each in fields(CalibrationTable):
        if each.name in Calibration.__dataclass_fields__:
            values[each.name] = getattr(table, each.name)
    values["mount"] = np.array([mount.x_m, mount.y_m, mount.yaw_rad])
    values["mount_sd"] = np.array([mount.x_sd_m, mount.y_sd_m, mount.yaw_sd_rad])
    return Calibration(digest=table.skin, **values)
