"""Readings of each taxel and each temperature channel of an untouched skin."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.noise import FLOOR
from taxeld.skin.channels import TEMPERATURE
from taxeld.skin.drift import T0_STEP
from taxeld.skin.rest import NOISE_MAX, NOISE_TELLS, SD_OF_STEP
from taxeld.skin.skin import INVALID_FROM
from taxeld_protocol.decoder import MISSING, Scan

STILL_SCANS = 50  # two readings with a noise of a count agree in 0.28 of cases: 1e-27 for fifty
INVALID = 0.01  # share of the scans
STANDS_OUT = 10.0  # times the skin's median noise; 23..59 counts is what 80 % of a skin lie in
SD_OF_MAD = 1.4826  # median absolute deviation → standard deviation, of a normal distribution
SD_OF_MEDIAN = np.sqrt(np.pi / 2.0)  # sd of the median of n normal readings, times √n
THRESHOLD_SIGMAS = SkinConfig().threshold_sigmas


class T0Readings(NamedTuple):
    """The T0 readings of a module; levels are in counts."""

    level: float  # median
    invalid: float  # share of the scans that read 0, or INVALID_FROM and more
    step: float  # greatest change of its median from one second to the next
    allowed: float  # greatest such change that a temperature, or this T0's noise, explains


@dataclass(frozen=True, slots=True)
class IdleReadings:
    """Readings by taxel (M,), nan where nothing came; and of T0 by module."""

    full_scale_counts: float
    temperature: Mapping[int, T0Readings]  # serial number of the module → readings
    scans: Floats  # number of scans with the taxel
    level: Floats  # median [counts]
    noise: Floats  # standard deviation, by the median absolute deviation [counts]
    zero: Floats  # share of the scans that read 0
    saturated: Floats  # share that read INVALID_FROM or more
    width: Floats  # highest reading less the lowest [counts]

    @property
    def present(self) -> Bools:
        """Which taxels (M,) were read in any scan."""
        return np.asarray(self.scans > 0)

    @property
    def failing(self) -> dict[str, Bools]:
        """Taxels (M,) that cannot be used, by their fault; each taxel has one at most."""
        saturated = self.saturated > INVALID
        dead = (self.zero > INVALID) & ~saturated
        fine = self.present & ~dead & ~saturated
        stuck = fine & (self.width == 0) & (self.scans >= STILL_SCANS)
        if self.median_noise(fine) < NOISE_TELLS:
            stuck[:] = False
        return {"dead": dead, "stuck": stuck, "saturated": saturated}

    @property
    def usable(self) -> Bools:
        """Taxels (M,) that were read and do not fail."""
        return np.asarray(self.present & ~np.any([*self.failing.values()], axis=0))

    @property
    def noisy(self) -> Bools:
        """Usable taxels (M,) whose noise the daemon would not accept, or stands out of the skin's.

        A noise under which the daemon's threshold is the same for all taxels does not matter."""
        usable = self.usable
        floor = FLOOR * self.full_scale_counts / THRESHOLD_SIGMAS
        limit = max(STANDS_OUT * self.median_noise(usable), floor)
        return np.asarray(usable & (self.noise > min(limit, NOISE_MAX * self.full_scale_counts)))

    @property
    def threshold(self) -> Floats:
        """(M,) counts over the idle level from which the daemon takes a reading for a touch."""
        return np.maximum(THRESHOLD_SIGMAS * self.noise, FLOOR * self.full_scale_counts)

    def median_noise(self, taxels: Bools) -> float:
        """Median noise of some taxels (M,) [counts]; 0 without any."""
        return float(np.median(self.noise[taxels])) if taxels.any() else 0.0


def measured(
    layout: Layout, scans: Sequence[Scan], period_s: float, full_scale_counts: float
) -> IdleReadings:
    """The readings of all hubs; scans from before a hub's last module table are left out."""
    values = _by_channel(scans)
    rows = np.full((len(layout), 6), np.nan)
    rows[:, 0] = 0
    temperature = {}
    for row, uid in zip(rows, layout.uid.tolist(), strict=True):
        t0 = uid & ~0xF | TEMPERATURE
        if uid in values:
            row[:] = _taxel(values[uid])
        if t0 in values and t0 >> 4 not in temperature:
            temperature[t0 >> 4] = _temperature(values[t0], period_s, full_scale_counts)
    return IdleReadings(full_scale_counts, temperature, *rows.T)


def _by_channel(scans: Sequence[Scan]) -> dict[int, Floats]:
    """UID of each channel that was heard → its readings (n,)."""
    found = {}
    for hub, version in {scan.ihb: scan.table_version for scan in scans}.items():
        own = [scan for scan in scans if (scan.ihb, scan.table_version) == (hub, version)]
        counts = np.array([scan.counts for scan in own], dtype=np.float64)
        uids = [uid for module in own[-1].table for uid in module.uids]
        for uid, column in zip(uids, counts.T, strict=True):
            if (column != MISSING).any():
                found[uid] = column[column != MISSING]
    return found


def _taxel(values: Floats) -> tuple[float, ...]:
    """The columns of `IdleReadings`, of one taxel's readings (n,)."""
    level = float(np.median(values))
    noise = SD_OF_MAD * float(np.median(np.abs(values - level)))
    zero, saturated = np.mean(values == 0), np.mean(values >= INVALID_FROM)
    return len(values), level, noise, float(zero), float(saturated), float(np.ptp(values))


def _temperature(values: Floats, period_s: float, full_scale_counts: float) -> T0Readings:
    """One module's T0, from its readings (n,)."""
    valid = values[(values > 0) & (values < INVALID_FROM)]
    a_second = max(round(1.0 / period_s), 1)
    seconds = len(valid) // a_second
    step = noise = 0.0
    if seconds > 1:
        noise = SD_OF_STEP * float(np.median(np.abs(np.diff(valid))))
        medians = np.median(valid[: seconds * a_second].reshape(seconds, a_second), axis=1)
        step = float(np.abs(np.diff(medians)).max())
    spread = SD_OF_MEDIAN * np.sqrt(2.0 / a_second) * noise  # sd of the difference of two medians
    allowed = max(T0_STEP * full_scale_counts, THRESHOLD_SIGMAS * float(spread))
    invalid = 1.0 - len(valid) / len(values)
    return T0Readings(float(np.median(values)), invalid, step, allowed)
