"""A calibration as a TOML file: written by `taxeld calibrate`, named by `skin.calibration`."""

import logging
import math
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from taxeld.config.file import text_of
from taxeld.config.tables import Config, SkinConfig
from taxeld.config.toml_tables import Bound, ConfigError, between, key, parse
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.skin import state
from taxeld.skin.calibration import Calibration
from taxeld.source import session

VERSION = 1
NO_CHECK = {"check": None, "doc": ""}
FUTURE_DAYS = 1.0  # a clock that is set wrong; more is a wrong file
log = logging.getLogger(__name__)


def _digest(text: str) -> str | None:
    return None if len(text) == 16 else "must be the 16 hex digits of a skin"


def _sorts(most: int) -> Bound:
    return lambda v: None if 1 <= v <= most else f"must be 1..{most}, not {v}"


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
    mount: MountTable = field(metadata=NO_CHECK)
    version: int = key(check=between(1, 1_000_000))
    t: float = key(check=between(0, 1e11), doc="Unix seconds")
    date: str = key(doc="the same, for a reader")
    skin: str = key(check=_digest, doc="digest of the taxels' places and UIDs")
    object: str = key()
    presses: int = key(check=_sorts(1_000_000))
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
    lines = [
        '# A taxeld calibration. Name it in the configuration: [skin] calibration = "THIS FILE"',
        "# sd: one standard deviation; of full scale and gains relative.",
        f"version = {VERSION}",
        f"t = {c.t:.3f}",
        f'date = "{date}"',
        f'skin = "{c.digest}"',
        f'object = "{name}"',
        f"presses = {c.presses}",
        f"full_scale_depth_m = {c.full_scale_depth_m:.6g}",
        f"full_scale_counts = {c.full_scale_counts:.1f}",
        f"full_scale_sd = {c.full_scale_sd:.5f}",
        f"bend = {c.bend:.5f}",
        f"bend_sd = {c.bend_sd:.5f}",
        f"noise_sigma = {c.noise_sigma:.5f}",
        f"gain_cv = {c.gain_cv:.4f}",
        "taxel = [",
    ]
    for i, uid in enumerate(layout.uid.tolist()):
        frozen = ", frozen = true" if c.frozen[i] else ""
        lines.append(
            f"  {{uid = {uid}, gain = {c.gain[i]:.5f}, gain_sd = {c.gain_sd[i]:.5f}, "
            f"onset = {c.onset[i]:.4f}, onset_sd = {c.onset_sd[i]:.4f}, "
            f"noise_counts = {c.noise_counts[i]:.2f}{frozen}}},"
        )
    (x, y, yaw), (x_sd, y_sd, yaw_sd) = c.mount, c.mount_sd
    lines += [
        "]",
        "",
        "[mount]  # of the sensor's frame in the frame that the robot tells of",
        f"x_m = {x:.6f}",
        f"y_m = {y:.6f}",
        f"yaw_rad = {yaw:.6f}",
        f"x_sd_m = {x_sd:.6f}",
        f"y_sd_m = {y_sd:.6f}",
        f"yaw_sd_rad = {yaw_sd:.6f}",
        "",
    ]
    return "\n".join(lines)


def read(path: Path, layout: Layout, full_scale_depth_m: float) -> Calibration:
    """The calibration of this very skin.

    Raises:
        SetupError: it is unreadable, damaged, or of another skin or depth.
    """
    cure = "; calibrate this skin (taxeld calibrate), or name its own file"
    if not path.is_file():
        raise SetupError(f"skin.calibration: there is no file {path}{cure}")
    try:
        table = parse(CalibrationTable, text_of(path), path.name)
    except ConfigError as error:
        more = f" (and {len(error.faults) - 1} more faults)" if len(error.faults) > 1 else ""
        fault = f"{error.faults[0]}{more}".replace("unreadable configuration", "unreadable")
        named = fault if path.name in fault else f"{path.name}: {fault}"
        raise SetupError(f"skin.calibration: {named}{cure}") from None
    if table.version != VERSION:
        raise SetupError(
            f"skin.calibration: {path.name} is of version {table.version}, not {VERSION}{cure}"
        )
    own = state.digest(layout)
    if table.skin != own or [t.uid for t in table.taxel] != layout.uid.tolist():
        raise SetupError(
            f"skin.calibration: {path.name} is of another layout ({table.skin}), not of "
            f"{layout.name} ({own}){cure}"
        )
    if not math.isclose(table.full_scale_depth_m, full_scale_depth_m, rel_tol=1e-3):
        raise SetupError(
            f"skin.calibration: {path.name} is for skin.full_scale_depth_m = "
            f"{table.full_scale_depth_m:g}, not {full_scale_depth_m:g}{cure}"
        )
    return _calibration(table)


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
    """The configured calibration at a Unix time; None where none is named, or where it cannot be
    used and the configuration says that it need not be: then a line in the log says why. What is
    `recorded` may be older than its calibration.

    Raises:
        SetupError: it cannot be used, or is too old.
    """
    if not config.calibration:
        return None
    try:
        found = read(Path(config.calibration), layout, config.full_scale_depth_m)
        age_days = found.age_days(now)
        if age_days > config.calibration_max_age_days:
            raise SetupError(
                f"skin.calibration: {Path(config.calibration).name} is {age_days:.0f} days old, "
                f"more than skin.calibration_max_age_days = {config.calibration_max_age_days:g}; "
                "calibrate the skin again (taxeld calibrate), or allow more days"
            )
        if age_days < -FUTURE_DAYS and not recorded:
            raise SetupError(
                f"skin.calibration: {Path(config.calibration).name} is from {-age_days:.0f} days "
                "ahead; set this machine's clock"
            )
    except SetupError as error:
        if config.calibration_required:
            raise
        log.warning("%s; the daemon runs without it", error)
        return None
    return found


def _calibration(table: CalibrationTable) -> Calibration:
    mount, taxels = table.mount, table.taxel
    return Calibration(
        t=table.t,
        digest=table.skin,
        object=table.object,
        presses=table.presses,
        full_scale_depth_m=table.full_scale_depth_m,
        full_scale_counts=table.full_scale_counts,
        full_scale_sd=table.full_scale_sd,
        bend=table.bend,
        bend_sd=table.bend_sd,
        mount=np.array([mount.x_m, mount.y_m, mount.yaw_rad]),
        mount_sd=np.array([mount.x_sd_m, mount.y_sd_m, mount.yaw_sd_rad]),
        noise_sigma=table.noise_sigma,
        gain_cv=table.gain_cv,
        gain=np.array([t.gain for t in taxels]),
        gain_sd=np.array([t.gain_sd for t in taxels]),
        onset=np.array([t.onset for t in taxels]),
        onset_sd=np.array([t.onset_sd for t in taxels]),
        noise_counts=np.array([t.noise_counts for t in taxels]),
        frozen=np.array([t.frozen for t in taxels], dtype=np.bool_),
    )
