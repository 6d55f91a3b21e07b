"""Counts → activations: which wire channel is which taxel, the idle baseline, what counts as felt.

CySkin counts are 16-bit and rise with pressure; noise differs by three decades between patches, so
every threshold is the taxel's own, learned while nothing touches.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from taxeld.config import SkinConfig
from taxeld.layout import Layout
from taxeld_protocol.decoder import Scan

INVALID_FROM = 43_000  # public tools treat counts of 0 and from here on as invalid
THRESHOLD_MIN = 0.01  # of full scale: below it a touch says nothing about the pose


@dataclass(frozen=True, slots=True)
class Activation:
    """What M taxels feel at time t."""

    t: float
    z: NDArray[np.float64]  # (M,) 0..1, exactly 0 where nothing is felt
    live: NDArray[np.bool_]  # (M,) whether the taxel spoke and can be believed


@dataclass(slots=True)
class SkinCounters:
    """Since start; channels are counted once a scan."""

    scans: int = 0
    invalid_counts: int = 0
    unmapped: int = 0  # scans of a module table that names no taxel of the layout


class Skin:
    """Activations of one skin, from scans of all hubs that its taxels hang on."""

    def __init__(self, layout: Layout, config: SkinConfig) -> None:
        self.layout = layout
        self.config = config
        self.counters = SkinCounters()
        self._index = {int(uid): i for i, uid in enumerate(layout.uid)}
        self._maps: dict[int, tuple[int, NDArray[np.intp], NDArray[np.intp]]] = {}
        self._counts = np.zeros(len(layout))
        self.tare()

    def tare(self) -> None:
        """Forget the baseline; the next `baseline_scans` scans, untouched, make a new one."""
        taxels = len(self.layout)
        self._idle_n = np.zeros(taxels)
        self._idle_mean = np.zeros(taxels)
        self._idle_square = np.zeros(taxels)  # summed squared deviations (Welford)
        self._idle_scans = 0
        self.baseline: NDArray[np.float64] | None = None
        self.live: NDArray[np.bool_] | None = None  # of the last activation
        self.threshold = np.zeros(taxels)

    def on_scan(self, scan: Scan) -> Activation | None:
        """The activation after this scan; None while the baseline is being learned."""
        self.counters.scans += 1
        channels, taxels = self._channels(scan)
        if not len(channels):
            self.counters.unmapped += 1
            return None
        values = np.asarray(scan.counts, dtype=np.float64)[channels]
        valid = (values > 0) & (values < INVALID_FROM)
        self.counters.invalid_counts += int(len(values) - valid.sum())
        self._counts[taxels] = np.where(valid, values, 0.0)
        if self.baseline is None:
            self._learn(values[valid], taxels[valid])
            return None
        return self._activation(scan.t)

    def _activation(self, t: float) -> Activation:
        assert self.baseline is not None  # noqa: S101  (the caller looked)
        live = (self._counts > 0) & (self._idle_n > 1)
        over = self._counts - self.baseline
        felt = live & (over > self.threshold)
        z = np.where(felt, np.clip(over / self.config.full_scale_counts, 0.0, 1.0), 0.0)
        self.live = live
        return Activation(t, z, live)

    def _learn(self, values: NDArray[np.float64], taxels: NDArray[np.intp]) -> None:
        self._idle_n[taxels] += 1
        delta = values - self._idle_mean[taxels]
        self._idle_mean[taxels] += delta / self._idle_n[taxels]
        self._idle_square[taxels] += delta * (values - self._idle_mean[taxels])
        self._idle_scans += 1
        if self._idle_scans >= self.config.baseline_scans:
            noise = np.sqrt(self._idle_square / np.maximum(self._idle_n - 1, 1))
            floor = THRESHOLD_MIN * self.config.full_scale_counts
            self.threshold = np.maximum(self.config.threshold_sigmas * noise, floor)
            self.baseline = self._idle_mean.copy()

    def _channels(self, scan: Scan) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Channels of the scan that are taxels of the layout, and which."""
        known = self._maps.get(scan.ihb)
        if known is None or known[0] != scan.table_version:
            uids = [uid for module in scan.table for uid in module.uids]
            pairs = [(c, self._index[uid]) for c, uid in enumerate(uids) if uid in self._index]
            channels, taxels = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
            known = scan.table_version, channels, taxels
            self._maps[scan.ihb] = known
        return known[1], known[2]
