"""Counts → activations: each taxel's reading over its idle baseline, and which can be believed.

CySkin counts have 16 bits and rise with pressure. Noise differs by three decades between patches,
so every taxel has its own threshold, learned while nothing touches the skin (`rest`). Then the
baseline follows drift (`drift`). The learned state can be kept over a restart. docs/skin.md has the
rules.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import Activation, Lesson
from taxeld.model.response import Inverse
from taxeld.skin.calibration import Calibration, SkinState, skin_digest
from taxeld.skin.channels import Wiring
from taxeld.skin.drift import Drift, Slice
from taxeld.skin.fit import SkinFit
from taxeld.skin.foam import Residue
from taxeld.skin.rest import Idle, Rest
from taxeld_protocol.decoder import Scan

INVALID_FROM = 43_000  # public tools treat counts of 0 and from here on as invalid
SILENT_S = 0.5  # time for which the readings of a hub's last scan hold
CONFIRMING = 0.5  # share of taxels that must answer, and of these that must read as stored


@dataclass(slots=True)
class SkinCounters:
    """Counters since start."""

    scans: int = 0
    unmapped: int = 0  # scans whose module table names no taxel of the layout
    learning: int = 0  # scans before any taxel had a baseline
    lowered: int = 0  # baselines that were above the readings of a free taxel and were lowered


class Skin:
    """Activations of one skin of M taxels on K modules, from scans of all its hubs."""

    def __init__(
        self,
        layout: Layout,
        config: SkinConfig,
        silent_s: float = SILENT_S,
        calibration: Calibration | None = None,
        noise: Noise | None = None,
    ) -> None:
        """`silent_s`: time for which a hub's readings hold without a new scan. `calibration`
        replaces the configured full scale. `noise`: errors of readings before anything is learned
        of them."""
        m = len(layout)
        self.layout = layout
        self.config = config
        self.counters = SkinCounters()
        self.digest = skin_digest(layout)
        self.captures = 0  # times that taxels got a baseline
        self.wiring = Wiring(layout)
        self.fit = SkinFit(m, noise or Noise(), calibration)
        self.noise: Noise | None = None  # errors of each taxel about its curve, where known
        self._calibrated_t, self._full_scale = 0.0, config.full_scale_counts
        self._own: Floats | float = config.full_scale_counts  # each taxel's counts at full depth
        self._inverse: Inverse | None = None  # None: activations are in proportion to counts
        if calibration is not None:
            self._calibrated_t, self._full_scale = calibration.t, calibration.full_scale_counts
            self._use_fit()
        self._floor = FLOOR * self._full_scale
        self._silent_s = silent_s
        self.threshold: Floats = np.zeros(m)
        self.over: Floats = np.zeros(m)  # (M,) counts over baseline of the last activation
        # counts of the last scan of taxels (M), then of temperatures (K), 0 where not valid
        self._counts: Floats = np.zeros(m + len(self.wiring.suis))
        self._saturated: Bools = np.zeros(len(self._counts), dtype=bool)
        self._usable: Bools = np.zeros(m, dtype=bool)  # (M,) has a baseline, and is not frozen
        self._last: dict[
            int, tuple[float, Index | slice]
        ] = {}  # hub → time of its last scan, its places
        self._t = -np.inf
        self._state: SkinState | None = None  # stored, and not confirmed for `_pending` taxels
        self._pending: Bools = np.zeros(m, dtype=bool)
        self._slice = Slice(len(self._counts))
        self._drift = Drift(layout, self.wiring, self._full_scale)
        self._rest = Rest(m, calibration)
        self._foam = Residue(m)
        self._unmarked: tuple[Floats, Floats] | None = None  # floors and residues without presses
        self.tare()

    def tare(self) -> None:
        """Forget the baseline; the next untouched scans make a new one."""
        self._idle = Idle(len(self.layout), self._full_scale, self._floor)
        self._state = None
        self._slice.begin(-np.inf)
        self._drift.release()
        self.live: Bools | None = None  # (M,) of the last activation
        self.touched = False  # whether the last activation is a touch

    @property
    def counts(self) -> Floats:
        """(M,) counts of each taxel's last scan, 0 where not valid."""
        return self._counts[: len(self.layout)]

    @property
    def baseline(self) -> Floats:
        """(M,) counts; meaningless where the baseline is not known."""
        return self._drift.baseline

    @property
    def hubs(self) -> int:
        """The number of hubs that have sent a scan lately."""
        return len(self._last)

    @property
    def is_ready(self) -> bool:
        """Whether any taxel has a baseline."""
        return bool(self._idle.known.any())

    def faults(self) -> dict[str, list[int]]:
        """Fault → taxels that cannot be believed for it; and the modules that no hub has."""
        masks = {
            "dead_taxels": np.zeros(0, dtype=bool) if self.live is None else ~self.live,
            "stuck_taxels": self._rest.frozen,
            "saturated_taxels": self._saturated[: len(self.layout)],
            "untared_taxels": ~self._idle.known,
        }
        found = {name: np.flatnonzero(mask).tolist() for name, mask in masks.items()}
        return found | {"missing_modules": list(self.wiring.lacking)}

    def teach(self, lesson: Lesson) -> None:
        """Learn how taxels respond, from contacts of a sure belief."""
        if self.fit.teach(lesson):
            self._use_fit()

    def _use_fit(self) -> None:
        gain, onset, _ = self.fit.fit.mean
        self._own, self._inverse = self._full_scale * gain, Inverse(self.fit.bend, onset)
        self._unmarked = None
        self.noise = self.fit.noise

    def on_scan(self, scan: Scan) -> Activation | None:
        """The activation after this scan; None while the baseline is being learned."""
        self.counters.scans += 1
        wired = self.wiring.of(scan)
        if not len(wired.taxels):
            self.counters.unmapped += 1
            return None
        self._age(scan.ihb, scan.t, wired.places)
        read = np.array(scan.counts, dtype=np.float64)[wired.channels]
        self._saturated[wired.places] = is_saturated = read >= INVALID_FROM
        read[is_saturated | (read < 0.0)] = 0.0
        changed = read != self._counts[wired.places]
        self._counts[wired.places] = read
        if scan.rest:
            self._take_rest(scan.rest)
            return self._activation()
        is_full = self._slice.add(self._t, wired.places, read, changed)
        if self._state is not None:
            self._confirm(self._state, wired.taxels)
        if not self._idle.known.all():
            was_ready = self.is_ready
            answered = wired.taxels[self._counts[wired.taxels] > 0]
            busy = self._drift.busy(self._t)
            self._know(*self._idle.on_scan(answered, self._counts[answered], busy))
            if not was_ready:
                self.counters.learning += 1
                return None
        activation = self._activation()
        if is_full:
            self._settle()
        return activation

    def _age(self, hub: int, t: float, places: Index | slice) -> None:
        """A hub has sent a scan of `places` (n,) at time t. Readings of hubs that have been silent
        too long end."""
        self._t = max(self._t, t)  # hubs end their scans in any order
        self._last[hub] = self._t, places
        for other, (last, silent) in list(self._last.items()):
            if self._t - last > self._silent_s:
                self._counts[silent] = 0.0
                del self._last[other]

    def _take_rest(self, rest: int) -> None:
        """The sender knows the baseline, so that nothing is learned of it."""
        if not self._idle.known.all():
            m = len(self.layout)
            self._state, self._idle.known[:] = None, True
            self._know(np.arange(m), np.full(m, float(rest)), np.zeros(m))

    def _know(self, taxels: Index, baseline: Floats, noise: Floats) -> None:
        """Set the baselines and noise (n,) of taxels (n,) [counts]."""
        if not len(taxels):
            return
        self.captures += 1
        self._drift.take(taxels, baseline)
        self._rest.take(taxels, noise)
        self.threshold[taxels] = self._threshold(self._rest.noise[taxels])
        self._usable, self._unmarked = self._idle.known & ~self._rest.frozen, None
        self._slice.begin(self._t)  # earlier readings may be a touch

    def _threshold(self, noise: Floats) -> Floats:
        """Thresholds of a touch for noise of any shape [counts]."""
        return np.maximum(self.config.threshold_sigmas * noise, self._floor)

    def _activation(self) -> Activation:
        live = self.live = (self.counts > 0) & self._usable
        over = self.over = self.counts - self.baseline
        self._foam.on_scan(np.where(live, over, 0.0), self.threshold)
        if self._foam.is_none:  # as nearly always
            self.touched = False
            if self._unmarked is None:
                self._unmarked = self._scaled(self.threshold), self._scaled(self._foam.level)
            return Activation(self._t, np.zeros(len(live)), live, *self._unmarked, self.noise)
        pressed, left = live & self._foam.pressed, self._foam.level
        self.touched = bool(pressed.any())
        self._drift.touched(self._t, pressed | (left > self.threshold))
        z, floor = np.where(pressed, self._scaled(over), 0.0), self._scaled(self.threshold + left)
        return Activation(self._t, z, live, floor, self._scaled(left), self.noise)

    def _scaled(self, over: Floats) -> Floats:
        """Activations (M,) in 0..1 of counts (M,) over baseline."""
        reading = np.minimum(np.maximum(over / self._own, 0.0), 1.0)
        return reading if self._inverse is None else self._inverse(reading)

    def _settle(self) -> None:
        """Learn from a second of scans: frozen taxels, drift, noise and thresholds."""
        part, known = self._slice, self._idle.known
        self._rest.stood_still(part, known)
        self._usable = known & ~self._rest.frozen
        self._rest.varied(part, self._drift.on_slice(part, self._usable, self.threshold))
        self.threshold, self._unmarked = self._threshold(self._rest.noise), None
        self.counters.lowered = self._drift.lowered
        part.begin(self._t)

    def state(self) -> SkinState | None:
        """The learned state, to be kept; None before anything was learned. After a tare it has no
        baseline."""
        if not self.captures:
            return None
        temperature = self._drift.temperature
        return SkinState(
            t=self._t,
            digest=self.digest,
            baseline=np.where(self._idle.known, self.baseline, np.nan),
            noise=self._rest.noise.copy(),
            coefficient=temperature.coefficient.copy(),
            leak=temperature.leak.copy(),
            t0=temperature.level,
            full_scale=self._full_scale,
            calibrated_t=self._calibrated_t,
            response=self.fit.values,
        )

    def restore(self, state: SkinState, *, baseline: bool = True) -> None:
        """Use a state from before a restart: the responses, where they were learned on the same
        scale, and the `baseline`, where the first scan of each hub confirms it. So a touch held
        over the restart is noticed, and a skin that has drifted too far, or is another one, is
        captured anew."""
        of = state.full_scale, state.calibrated_t
        if self.config.learn and of == (self._full_scale, self._calibrated_t):
            self.fit.restore(state.response)
            self._use_fit()
        if baseline and not np.isnan(state.baseline).all():
            self._state = state
            self._pending = ~np.isnan(state.baseline)
            self._drift.temperature.coefficient = state.coefficient.copy()
            self._drift.temperature.set_leak(state.leak)

    def _confirm(self, state: SkinState, taxels: Index) -> None:
        """Use or refuse the stored state of a hub's taxels (n,), by the counts of its first
        scan."""
        asked = taxels[self._pending[taxels]]
        answered = self.counts[asked] > 0
        if not answered.any() or answered.mean() < CONFIRMING:
            return
        self._pending[asked] = False
        module, threshold = self.wiring.module[asked], self._threshold(state.noise[asked])
        over = np.where(answered, self.counts[asked] - state.baseline[asked], 0.0)
        press = np.bincount(module, np.where(over > threshold, over, 0.0), len(state.t0))
        t0 = self._counts[len(self.layout) :]
        warmer = np.where(t0 > 0, t0 - state.leak * press - state.t0, 0.0)
        moved = (state.coefficient * np.nan_to_num(warmer))[module]
        is_close = np.abs(over - moved) <= threshold
        if is_close[answered].mean() < CONFIRMING:
            self._state = None
            return
        self._idle.known[asked] = True
        self._know(asked, state.baseline[asked] + moved, state.noise[asked])
        if not self._pending.any():
            self._state = None
