"""A calibration as a TOML file: written by `taxeld calibrate`, named by `skin.calibration`."""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.config.file import text_of
from taxeld.config.gate import ConfigError, between, key, parse
from taxeld.config.tables import SkinConfig
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.skin.calibration import DAY_S, Calibration, skin_digest

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
    frozen: bool = key()
    answers: float = key(check=between(0, 1))


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


HEAD = """\
# A taxeld calibration. Name it in the configuration: [skin] calibration = "THIS FILE"
# sd: one standard deviation; of full scale and gains relative.
"""
# keys of the tables whose values a `Calibration` has, under the same names
OWN = [f.name for f in fields(CalibrationTable) if f.name in Calibration.__dataclass_fields__]
OWN.remove("mount")
OF_TAXELS = [f.name for f in fields(TaxelTable) if f.name != "uid"]
MOUNT = [f.name for f in fields(MountTable)]  # the pose (3,), then its sd (3,)


def dump(c: Calibration, layout: Layout) -> str:
    """The file's text."""
    date = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(c.t))
    about = {"version": VERSION, "skin": c.digest, "date": date}
    columns = [layout.uid.tolist(), *(getattr(c, name).tolist() for name in OF_TAXELS)]
    rows = (dict(zip(("uid", *OF_TAXELS), row, strict=True)) for row in zip(*columns, strict=True))
    mount = dict(zip(MOUNT, np.concatenate([c.mount, c.mount_sd]).tolist(), strict=True))
    lines = [
        *_pairs(about | {name: getattr(c, name) for name in OWN}),
        "taxel = [",
        *(f"  {{{', '.join(_pairs(row))}}}," for row in rows),
        "]",
        "",
        "[mount]  # of the sensor's frame in the frame of the robot's poses",
        *_pairs(mount),
    ]
    return HEAD + "\n".join(lines) + "\n"


def _pairs(table: Mapping[str, Any]) -> list[str]:
    """A line of TOML for each key; numbers of six decimals. JSON's scalars are TOML's as well."""
    plain = {k: round(v, 6) if isinstance(v, float) else v for k, v in table.items()}
    return [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in plain.items()]


def load(
    config: SkinConfig, layout: Layout, now: float, *, recorded: bool = False
) -> Calibration | None:
    """The configured calibration at a Unix time; None where none is named. What is `recorded` may
    be older than its calibration.

    Raises:
        SetupError: it is unreadable, damaged, too old, or of another skin or depth.
    """
    if not config.calibration:
        return None
    path = Path(config.calibration)
    try:
        table = parse(CalibrationTable, text_of(path), path.name)
    except ConfigError as error:
        first = error.faults[0].removeprefix(f"{path.name}: ").removeprefix(f"{path}: ")
        fault = first.replace("unreadable configuration", "unreadable").split("; name a")[0]
        fault += f"; {len(error.faults) - 1} more faults" if len(error.faults) > 1 else ""
    else:
        ahead_s = 0.0 if recorded else max(table.t - now, 0.0)
        fault = _fault(table, config, layout, max(now - table.t, 0.0) / DAY_S, ahead_s / DAY_S)
        if not fault:
            return _calibration(table)
    raise SetupError(
        f"skin.calibration: {path.name}: {fault}; calibrate this skin (taxeld calibrate), "
        "or name its own file"
    )


def _fault(
    table: CalibrationTable, config: SkinConfig, layout: Layout, age_days: float, ahead_days: float
) -> str:
    """Why a calibration cannot be used; empty where it can."""
    own, depth_m = skin_digest(layout), config.full_scale_depth_m
    if table.version != VERSION:
        return f"it is of version {table.version}, not {VERSION}"
    if table.skin != own or [t.uid for t in table.taxel] != layout.uid.tolist():
        return f"it is of another layout ({table.skin}), not of {layout.name} ({own})"
    if not math.isclose(table.full_scale_depth_m, depth_m, rel_tol=1e-3):
        return f"it is for skin.full_scale_depth_m = {table.full_scale_depth_m:g}, not {depth_m:g}"
    if age_days > MAX_AGE_DAYS:
        return f"it is {age_days:.0f} days old, more than {MAX_AGE_DAYS:g}"
    if ahead_days > FUTURE_DAYS:
        return f"it is from {ahead_days:.0f} days ahead: set this machine's clock"
    return ""


def _calibration(table: CalibrationTable) -> Calibration:
    """The table with its taxels in columns."""
    mount = np.array([getattr(table.mount, name) for name in MOUNT])
    values: dict[str, Any] = {name: getattr(table, name) for name in OWN}
    for name in OF_TAXELS:
        values[name] = np.array([getattr(taxel, name) for taxel in table.taxel])
    return Calibration(digest=table.skin, mount=mount[:3], mount_sd=mount[3:], **values)
