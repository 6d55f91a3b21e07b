"""What each taxel and each temperature channel read over a period in which nothing touched."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.layout.layout import Layout
from taxeld.skin.capture import SD_OF_STEP
from taxeld.skin.channels import Wired, Wiring
from taxeld.skin.skin import INVALID_FROM
from taxeld_protocol.decoder import MISSING, Scan

SD_OF_MAD = 1.4826  # median absolute deviation → standard deviation, of a normal distribution


@dataclass(frozen=True, slots=True)
class IdleReadings:
    """By taxel (M,) and by module's T0 (K,); nan, or 0 scans, where nothing came."""

    scans: Floats  # in which the taxel was read
    level: Floats  # median [counts]
    noise: Floats  # sd, by the median absolute deviation [counts]
    zero: Floats  # share of the scans that read 0
    saturated: Floats  # share that read INVALID_FROM or more
    still: Bools  # not a single count of change
    t0_level: Floats
    t0_invalid: Floats  # share
    t0_noise: Floats  # sd, by the changes from scan to scan [counts]
    t0_step: Floats  # most that its median changed within a second [counts]

    @property
    def present(self) -> Bools:
        """Which taxels were read in any scan."""
        return np.asarray(self.scans > 0)


def readings(layout: Layout, scans: Sequence[Scan], period_s: float) -> IdleReadings:
    """Over the scans of all hubs; those from before a hub's last module table are left out."""
    wiring = Wiring(layout)
    taxels, modules = len(layout), len(wiring.suis)
    level, noise, zero, saturated = np.full((4, taxels), np.nan)
    read, still = np.zeros(taxels), np.zeros(taxels, dtype=bool)
    t0_level, t0_invalid, t0_noise, t0_step = np.full((4, modules), np.nan)
    for counts, wired in _by_hub(scans, wiring):
        at, values = wired.taxels, counts[:, wired.channels]
        n = np.isfinite(values).sum(axis=0)
        at, values = at[n > 0], values[:, n > 0]
        read[at] = n[n > 0]
        level[at] = np.nanmedian(values, axis=0)
        noise[at] = SD_OF_MAD * np.nanmedian(np.abs(values - level[at]), axis=0)
        zero[at] = (values == 0).sum(axis=0) / read[at]
        saturated[at] = (values >= INVALID_FROM).sum(axis=0) / read[at]
        still[at] = np.nanmin(values, axis=0) == np.nanmax(values, axis=0)
        t0 = counts[:, wired.t0_channels]
        heard = np.isfinite(t0).any(axis=0)
        at, t0 = wired.t0_modules[heard], t0[:, heard]
        t0_level[at] = np.nanmedian(t0, axis=0)
        valid = np.isfinite(t0) & (t0 > 0) & (t0 < INVALID_FROM)
        t0_invalid[at] = 1.0 - valid.sum(axis=0) / np.isfinite(t0).sum(axis=0)
        t0_noise[at] = SD_OF_STEP * _middle(np.abs(np.diff(t0, axis=0)))
        t0_step[at] = _steps(np.where(valid, t0, np.nan), max(round(1.0 / period_s), 1))
    return IdleReadings(
        read, level, noise, zero, saturated, still, t0_level, t0_invalid, t0_noise, t0_step
    )  # fmt: skip


def _by_hub(scans: Sequence[Scan], wiring: Wiring) -> list[tuple[Floats, Wired]]:
    """Each hub's counts (scans, channels), nan where lost, and what its channels read."""
    newest = {scan.ihb: scan.table_version for scan in scans}
    found = []
    for hub, version in newest.items():
        own = [scan for scan in scans if (scan.ihb, scan.table_version) == (hub, version)]
        counts = np.array([scan.counts for scan in own], dtype=np.float64)
        counts[counts == MISSING] = np.nan
        found.append((counts, wiring.of(own[-1])))
    return found


def _steps(t0: Floats, per_second: int) -> Floats:
    """The greatest change between the medians of consecutive seconds, channel by channel."""
    whole = len(t0) // per_second
    if whole < 2:
        return np.zeros(t0.shape[1])
    seconds = t0[: whole * per_second].reshape(whole, per_second, -1)
    change = _middle(seconds.swapaxes(0, 1))
    return np.asarray(np.nan_to_num(np.abs(np.diff(change, axis=0))).max(axis=0))


def _middle(values: Floats) -> Floats:
    """Medians along the first axis, nan where there is nothing else."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    found = np.ma.median(np.ma.masked_invalid(values), axis=0)  # type: ignore[no-untyped-call]
    return np.ma.filled(found, np.nan)
