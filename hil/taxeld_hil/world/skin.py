"""A simulated skin: the counts of its taxels, which all differ, by how deep each is pressed.

What a taxel has drawn for itself lasts; what a press draws ends with it. Foam acts on what a taxel
reads of a press before its gain, and cross-talk on counts, as recordings give both as shares of
readings. With every effect off (`PLAIN`) a taxel reads its depth, times its gain.
"""

from collections.abc import Callable, Sequence

import numpy as np

from taxeld.arrays import Floats, Index, Poses
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.skin.calibration import Calibration
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.soft_skin import Foam, PerPress, Response, cross_talk, drawn
from taxeld_protocol.modules import Module

COUNT_MAX = 0xFFFF
T0_COUNTS = 12_000  # level of every module's temperature channel; a press hardly moves it
T0_LEAK = 0.02  # share of a press that it reads: 356 of 8 500 counts on a real skin
LEAST_GAIN = 0.1
# (noise_sigma, gain_cv) that calibrations of these foams find; the mean of two runs each
LEFT = {
    "scene": (0.02, 0.02),
    "typical": (0.058, 0.08),
    "poor": (0.058, 0.09),
    "stiff": (0.028, 0.08),
}
STILL = 3.0  # standard deviations beyond which no baseline is drawn: it must stay a reading

Body = Callable[[Poses, Floats], Floats]
"""Object poses (K, 3) in the sensor frame, the sag's length of each taxel (M,) [m] → how deep the
nearest of them presses each taxel (M,), in depths at full scale."""


def exact(model: ObservationModel) -> Body:
    """Presses as the estimator expects them."""
    # the farthest that a taxel touches; a mug's handle is no part of its outline
    reach_m = float(np.hypot(*np.abs(model.scene.extent).max(axis=0))) + model.layout.radius_m

    def pressed(seen: Poses, _sag_m: Floats) -> Floats:
        near = seen[np.hypot(seen[:, 0], seen[:, 1]) <= reach_m]  # of most of a path there is none
        if not len(near):
            return np.zeros(len(model.layout))
        return np.asarray(model.activation(near).max(axis=0))

    return pressed


class SimulatedSkin:
    """The skin of one link, of M taxels."""

    def __init__(
        self,
        given: Conditions,
        layout: Layout,
        modules: Sequence[Module],
        body: Body,
        rng: np.random.Generator,
    ) -> None:
        """`rng` draws baselines and gains, then the noise; what else a skin draws comes from
        generators of its own. So a seed has the same baselines on every foam, and gains that differ
        by their spread alone."""
        taxels, skin = len(layout), given.skin
        self._given, self._body, self._rng = given, body, rng
        # of each channel of a scan: its taxel, -1 where it is a T0, and its module
        index = {uid: i for i, uid in enumerate(layout.uid.tolist())}
        self._taxel = np.array([index.get(uid, -1) for own in modules for uid in own.uids])
        self._module = np.repeat(range(len(modules)), [own.channels for own in modules])
        still = np.clip(rng.standard_normal(taxels), -STILL, STILL)
        self.baseline = given.baseline_counts + given.baseline_spread * still
        gain = np.maximum(1.0 + skin.gain_cv * rng.standard_normal(taxels), LEAST_GAIN)
        self.full_scale: Floats = given.full_scale_counts * gain
        self._noise = drawn(skin.noise_counts, rng.spawn(1)[0].standard_normal(taxels))
        own, faults = rng.spawn(2)
        self.depth: Floats = np.zeros(taxels)  # (M,) of the last press, sag included
        self._sag_m = PerPress(skin.sag_m, taxels, own)
        self.response = Response(skin, taxels, own)
        self._foam = Foam(skin, taxels, own)
        self._cross_talk = cross_talk(layout, skin.cross_talk, own)
        # the temperature adds one slow sine wave, and each taxel has a share of it
        self._rate = 2.0 * np.pi / skin.drift_period_s
        self._thermal_counts = skin.drift_counts_per_min / 60.0 / self._rate
        self._phase = own.uniform(-np.pi, np.pi)
        self._share = 1.0 + skin.drift_cv * own.standard_normal(taxels)
        self._drift = given.drift / 60.0 * given.full_scale_counts * faults.uniform(-1, 1, taxels)
        self._stuck: Index = faults.permutation(taxels)[: given.stuck]
        scattered = faults.permutation(taxels)[: round(given.dead_share * taxels)]
        names, module = np.unique(layout.uid >> 4, return_inverse=True)
        gone = faults.permutation(len(names))[: given.dead_modules]
        self._dead = np.isin(module, gone) | np.isin(np.arange(taxels), scattered)

    def calibration(self, depth_m: float) -> Calibration:
        """What a calibration would tell of it, as exact as one can be; `depth_m`: of a press at
        full scale."""
        zeros, given = np.zeros(len(self.depth)), self._given
        noise_sigma, gain_cv = LEFT[given.foam]
        return Calibration(
            t=0.0,
            digest="",
            object="",
            presses=0,
            full_scale_depth_m=depth_m,
            full_scale_counts=given.full_scale_counts,
            full_scale_sd=0.0,
            bend=given.skin.bend,
            bend_sd=0.0,
            mount=np.zeros(3),
            mount_sd=np.zeros(3),
            noise_sigma=noise_sigma,
            gain_cv=gain_cv,
            gain=self.full_scale / given.full_scale_counts,
            gain_sd=zeros,
            onset=self.response.steeper,
            onset_sd=zeros,
            noise_counts=given.skin.noise_counts[0] + zeros,
            frozen=zeros > 0.0,
        )

    def press(self, seen: Poses, t: float) -> Floats:
        """(M,) counts of presses, with objects at poses (K, 3) in the sensor frame at t [s]; times
        do not go back."""
        was_pressed = self.depth.any()
        self.depth = self._body(seen, self._sag_m.now)
        if was_pressed and not self.depth.any():
            self._sag_m.draw()
            self._foam.end()
        if not self.depth.any() and not self._foam.is_felt:
            return np.zeros(len(self.depth))
        counts = self.full_scale * self._foam.press(self.response(self.depth), t)
        return np.asarray(counts + self._cross_talk @ counts)

    def counts(self, seen: Poses, t: float, *, touching: bool) -> list[int]:
        """One scan, channel by channel, as of `press`; 0 where a taxel is dead. `touching`: whether
        the first touch has begun."""
        press = self.press(seen, t)
        thermal = self._thermal_counts * np.sin(self._rate * t + self._phase)
        drift = thermal * self._share + t * self._drift
        noise = self._noise * self._rng.standard_normal(len(press))
        taxels = self.baseline + press + drift + noise
        if touching and len(self._stuck):
            full = self._given.stuck_at * self._given.full_scale_counts
            taxels[self._stuck] = self.baseline[self._stuck] + full
        at, module = self._taxel, self._module
        pressed = np.where(at >= 0, press[at], 0.0)
        leak = np.bincount(module, pressed)[module] * T0_LEAK
        values = np.where(at >= 0, taxels[at], T0_COUNTS + leak + thermal)
        counts = np.clip(np.round(values), 1, COUNT_MAX - 1)
        found: list[int] = np.where((at >= 0) & self._dead[at], 0.0, counts).astype(int).tolist()
        return found
