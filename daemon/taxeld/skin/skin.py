"""Counts → activations: each taxel's reading over its idle baseline, and which can be believed.

CySkin counts have 16 bits and rise with pressure. Noise differs by three decades between patches,
so every taxel has its own threshold, learned while nothing touches the skin (`capture`). Then the
baseline follows drift (`drift`). The learned state can be kept over a restart (`state`).
docs/skin.md has the rules.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Bools, Floats, Index
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.noise import FLOOR, Noise
from taxeld.model.observation import Activation, Lesson
from taxeld.model.response import Inverse
from taxeld.skin import state as skin_state
from taxeld.skin.calibration import Calibration, Scale
from taxeld.skin.capture import Idle
from taxeld.skin.channels import Wired, Wiring
from taxeld.skin.drift import Drift, Slice
from taxeld.skin.fit import SkinFit
from taxeld.skin.foam import Residue
from taxeld.skin.rest import Rest
from taxeld.skin.state import SkinState
from taxeld_protocol.decoder import Scan

INVALID_FROM = 43_000  # public tools treat counts of 0 and from here on as invalid
BASELINE_SCANS = 20  # untouched scans that make a baseline
SILENT_S = 0.5  # time for which the readings of a hub's last scan hold


@dataclass(slots=True)
class SkinCounters:
    """Counters of scans, since start."""

    scans: int = 0
    unmapped: int = 0  # scans whose module table names no taxel of the layout
    learning: int = 0  # scans before any taxel had a baseline


class Reading(NamedTuple):
    """A hub's readings: counts, 0 where not valid."""

    counts: Floats  # (n,) counts of the hub's taxels
    valid: Bools | int  # (n,), or 1 where all are valid
    t0: Floats  # (k,) counts of the hub's temperatures
    t0_valid: Bools | int


class Marks(NamedTuple):
    """The remains of presses, in the form of an activation."""

    floor: Floats
    residue: Floats


class Skin:
    """Activations of one skin, from scans of all its hubs."""

    def __init__(
        self,
        layout: Layout,
        config: SkinConfig,
        silent_s: float = SILENT_S,
        calibration: Calibration | None = None,
        baseline_scans: int = BASELINE_SCANS,
        noise: Noise | None = None,
    ) -> None:
        """`silent_s`: time for which a hub's readings hold without a new scan. `calibration`
        replaces the configured full scale. `baseline_scans`: untouched scans that make a
        baseline. `noise`: errors of readings before anything is learned of them."""
        taxels = len(layout)
        self.layout = layout
        self.config = config
        self.counters = SkinCounters()
        self.digest = skin_state.digest(layout)
        self.captures = 0  # times that taxels got a baseline
        self.live: Bools | None = None  # (M,) of the last activation
        self.touched = False  # whether the last activation is a touch
        self.threshold: Floats = np.zeros(taxels)
        self.over: Floats = np.zeros(taxels)  # (M,) counts over baseline of the last activation
        self._calibrated_t = 0.0 if calibration is None else calibration.t
        self._silent_s = silent_s
        self._baseline_scans = baseline_scans
        self._scale = Scale.used(config.full_scale_counts, calibration)
        self.fit = SkinFit(taxels, noise or Noise(), calibration)
        self.noise: Noise | None = None  # errors of each taxel about its curve, where known
        if noise is not None and calibration is not None:
            self.noise = self.fit.noise
        self._floor = FLOOR * self._scale.full_scale_counts
        self.wiring = Wiring(layout)
        self._counts: Floats = np.zeros(taxels)  # (M,) of each taxel's last scan, 0 where not valid
        self._saturated: Bools = np.zeros(taxels, dtype=bool)
        self._usable: Bools = np.zeros(taxels, dtype=bool)  # (M,) has a baseline, and is not frozen
        self._last_scans: dict[
            int, tuple[float, Index | slice]
        ] = {}  # hub → time of its last scan, and its taxels
        self._t = -np.inf
        self._state: SkinState | None = None  # stored, and not confirmed for `_pending` taxels
        self._pending = np.zeros(taxels, dtype=bool)
        self._slice = Slice(taxels, len(self.wiring.suis))
        self._drift = Drift(layout, self.wiring, self._scale.full_scale_counts)
        self._rest = Rest(taxels, calibration)
        self._residue = Residue(taxels)
        self._marks: Marks | None = None  # marks without presses, at the current thresholds
        self.tare()

    def tare(self) -> None:
        """Forget the baseline; the next untouched scans make a new one."""
        self._idle = Idle(
            len(self.layout), self._baseline_scans, self._scale.full_scale_counts, self._floor
        )
        self._state = None
        self._slice.begin(-np.inf)
        self._drift.release()
        self.live = None
        self.touched = False

    @property
    def counts(self) -> Floats:
        """(M,) counts of each taxel's last scan, 0 where not valid."""
        return self._counts

    @property
    def baseline(self) -> Floats:
        """(M,) counts; meaningless where the baseline is not known."""
        return self._drift.baseline

    @property
    def modules(self) -> int:
        """The number of modules with taxels of the layout."""
        return len(self.wiring.suis)

    @property
    def hubs(self) -> int:
        """The number of hubs that have sent a scan lately."""
        return len(self._last_scans)

    @property
    def is_ready(self) -> bool:
        """Whether any taxel has a baseline."""
        return bool(self._idle.known.any())

    def teach(self, lesson: Lesson) -> None:
        """Learn how taxels respond, from contacts of a sure belief."""
        if self.fit.teach(lesson):
            self._use_fit()

    def _use_fit(self) -> None:
        gain, onset, _ = self.fit.fit.mean
        full = self._scale.full_scale_counts
        self._scale = Scale(full, full * gain, Inverse(self.fit.bend, onset))
        self.noise, self._marks = self.fit.noise, None

    def on_scan(self, scan: Scan) -> Activation | None:
        """The activation after this scan; None while the baseline is being learned."""
        self.counters.scans += 1
        wired = self.wiring.of(scan)
        taxels = wired.taxels
        if not len(taxels):
            self.counters.unmapped += 1
            return None
        read = self._read(scan.counts, wired)
        self._age(scan.ihb, scan.t, wired.places)
        if scan.rest:
            self._counts[wired.places] = read.counts
            return self._given(scan.rest)
        before = self._counts[wired.places]
        full = self._slice.add(
            self._t, wired.places, read.counts, read.valid, read.counts != before
        )
        self._counts[wired.places] = read.counts
        self._slice.add_t0(wired.t0_modules, read.t0, read.t0_valid)
        if self._state is not None:
            self._judge(self._state, wired, read.counts, np.where(read.t0 > 0, read.t0, np.nan))
        if not self._idle.known.all():
            was_ready = self.is_ready
            answered = read.counts > 0
            self._capture(taxels[answered], read.counts[answered])
            if not was_ready:
                self.counters.learning += 1
                return None
        activation = self._activation()
        if full:
            self._settle()
        return activation

    def _given(self, rest: int) -> Activation:
        """The activation of readings whose baseline the sender knows: nothing is learned of it."""
        if not self._idle.known.all():
            taxels = np.arange(len(self.layout))
            self._state, self._idle.known[:] = None, True
            self._know(taxels, np.full(len(taxels), float(rest)), np.zeros(len(taxels)))
        return self._activation()

    def restore(self, state: SkinState, *, baseline: bool = True) -> None:
        """Use a state from before a restart: the responses, where they were learned on the same
        scale, and the `baseline`, where the first scans confirm it."""
        of = state.full_scale, state.calibrated_t
        if self.config.learn and of == (self._scale.full_scale_counts, self._calibrated_t):
            self.fit.restore(np.stack([getattr(state, name) for name in skin_state.RESPONSE]))
            self._use_fit()
        if not baseline:
            return
        self._state = state
        self._pending = ~np.isnan(state.baseline)
        self._drift.temperature.coefficient = state.coefficient.copy()
        self._drift.temperature.set_leak(state.leak)

    def state(self) -> SkinState | None:
        """The learned state, to be kept; None before anything was learned."""
        if not self.is_ready:
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
            full_scale=self._scale.full_scale_counts,
            calibrated_t=self._calibrated_t,
            **dict(zip(skin_state.RESPONSE, self.fit.values, strict=True)),
        )

    def faults(self) -> dict[str, list[int]]:
        """Fault → taxels that cannot be believed for it."""
        live = self.live
        return {
            "dead_taxels": [] if live is None else np.flatnonzero(~live).tolist(),
            "stuck_taxels": np.flatnonzero(self._rest.frozen).tolist(),
            "saturated_taxels": np.flatnonzero(self._saturated).tolist(),
            "untared_taxels": np.flatnonzero(~self._idle.known).tolist(),
            "missing_modules": list(self.wiring.lacking),
        }

    @property
    def lowered(self) -> int:
        """Baselines that were above the readings of a free taxel and were lowered, since start."""
        return self._drift.dips.lowered

    def _read(self, counts: tuple[int, ...], wired: Wired) -> Reading:
        channels = np.array(counts, dtype=np.float64)
        if min(counts) > 0 and max(counts) < INVALID_FROM:  # the usual case: all are valid
            self._saturated[wired.places] = False
            return Reading(channels[wired.channels], 1, channels[wired.t0_channels], 1)
        found, t0 = channels[wired.channels], channels[wired.t0_channels]
        valid, t0_valid = (found > 0) & (found < INVALID_FROM), (t0 > 0) & (t0 < INVALID_FROM)
        self._saturated[wired.places] = found >= INVALID_FROM
        return Reading(np.where(valid, found, 0.0), valid, np.where(t0_valid, t0, 0.0), t0_valid)

    def _age(self, hub: int, t: float, taxels: Index | slice) -> None:
        """A hub has sent a scan of taxels (n,) at time t. Readings of hubs that have been silent
        too long end."""
        self._t = max(self._t, t)  # hubs end their scans in any order
        self._last_scans[hub] = self._t, taxels
        for other, (last, silent) in list(self._last_scans.items()):
            if self._t - last > self._silent_s:
                self._counts[silent] = 0.0
                del self._last_scans[other]

    def _judge(self, state: SkinState, wired: Wired, counts: Floats, t0: Floats) -> None:
        """Use or refuse the stored state of a hub's taxels, by the counts (n,) and temperatures
        (k,) of its first scan."""
        taxels = wired.taxels
        asked = self._pending[taxels]
        answered = asked & (counts > 0)
        if not answered.any() or 2 * answered.sum() < asked.sum():
            return
        self._pending[taxels] = False
        noise, module = state.noise[taxels], self.wiring.module[taxels]
        threshold = self._threshold(noise)
        over = np.where(answered, counts - state.baseline[taxels], 0.0)
        press = np.bincount(module, np.where(over > threshold, over, 0.0), len(state.t0))
        warmer = np.zeros(len(state.t0))
        warmer[wired.t0_modules] = t0 - (state.leak * press + state.t0)[wired.t0_modules]
        moved = (state.coefficient * np.nan_to_num(warmer))[module]
        if not skin_state.is_confirmed(over - moved, threshold, answered):
            self._state = None
            return
        self._idle.known[taxels[asked]] = True
        self._know(taxels[asked], (state.baseline[taxels] + moved)[asked], noise[asked])
        if not self._pending.any():
            self._state = None

    def _capture(self, taxels: Index, counts: Floats) -> None:
        """Learn the baselines of taxels (n,) that have none yet, from their counts (n,)."""
        found = self._idle.on_scan(taxels, counts, self._drift.busy(self._t))
        if len(found):
            self._know(found, self._idle.mean[found], self._idle.noise[found])

    def _know(self, taxels: Index, baseline: Floats, noise: Floats) -> None:
        """Set the baselines and noise (n,) of taxels (n,) [counts]."""
        self.captures += 1
        self._drift.take(taxels, baseline)
        self._rest.take(taxels, noise, self._baseline_scans)
        self.threshold[taxels] = self._threshold(self._rest.noise[taxels])
        self._marks = None
        self._usable = self._idle.known & ~self._rest.frozen
        self._slice.begin(self._t)  # earlier readings may be a touch

    def _threshold(self, noise: Floats) -> Floats:
        """Thresholds of a touch for noise of any shape [counts]."""
        return np.maximum(self.config.threshold_sigmas * noise, self._floor)

    def _activation(self) -> Activation:
        scale, residue = self._scale, self._residue
        live = self.live = (self._counts > 0) & self._usable
        over = self.over = self._counts - self.baseline
        residue.on_scan(np.where(live, over, 0.0), self.threshold)
        if residue.is_none:
            self.touched = False
            return Activation(self._t, np.zeros(len(live)), live, *self._unmarked(), self.noise)
        pressed = live & residue.pressed
        self.touched = bool(pressed.any())
        if not residue.level.any():  # the first press for a long time
            self._drift.touched(self._t, pressed)
            marks = self._unmarked()
        else:
            self._drift.touched(self._t, pressed | (residue.level > self.threshold))
            left = scale.activation(residue.level)
            marks = Marks(scale.activation(self.threshold + residue.level), left)
        z = np.where(pressed, scale.activation(over), 0.0)
        return Activation(self._t, z, live, *marks, self.noise)

    def _unmarked(self) -> Marks:
        """Marks where presses have left nothing."""
        if self._marks is None:
            floor, nothing = self._scale.activation(self.threshold), np.zeros(len(self.threshold))
            self._marks = Marks(floor, self._scale.activation(nothing))
        return self._marks

    def _settle(self) -> None:
        """Learn from a second of scans: frozen taxels, drift, noise and thresholds."""
        part, known = self._slice, self._idle.known
        self._rest.stood_still(part.scans, part.changed, known)
        self._usable = known & ~self._rest.frozen
        at_rest = self._drift.on_slice(part, self._usable, self.threshold)
        self._rest.varied(part.variance, part.scans, at_rest)
        self.threshold, self._marks = self._threshold(self._rest.noise), None
        part.begin(self._t)
