"""A simulated skin: the counts of its taxels, which all differ, by how deep each is pressed.

What a taxel has drawn for itself lasts; what a press draws ends with it. Either comes from a
lognormal that two quantiles give. Foam acts on what a taxel reads of a press before its gain, and
cross-talk on counts, as recordings give both as shares of readings. With every effect off (`PLAIN`)
a taxel reads its depth, times its gain.
"""

from collections.abc import Callable, Sequence

import numpy as np

from taxeld.arrays import Floats, Index, Poses
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.model.response import GRID, deviation, response
from taxeld.skin.calibration import Calibration
from taxeld_protocol.modules import Module
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.mesh_config import MeshConfig, Pair
from taxeld_sim.world.mesh_skin import UPRIGHT

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
P90 = 1.2815515655446004  # the 90th percentile of a standard normal
FARTHEST = 2.0  # standard deviations: nothing is drawn beyond the 2nd and the 98th percentile
TURN = 0.1  # travel back, in full scales, after which the foam is on its other branch
ALIKE = 1.4  # how alike taxels are in their shares of answers: a and b of their beta add up to it
LEAST_SLOPE = 0.1  # least slope of a response: a harder press reads more

Body = Callable[[Poses, Floats, Floats], Floats]
"""Object poses (K, 3) in the upright sensor frame, the sag's length of each taxel (M,) [m], the
link's turn (3, 3) in that frame → how deep the nearest of them presses each taxel (M,), in depths
at full scale."""


def exact(model: ObservationModel) -> Body:
    """Presses as the estimator expects them, of a link that is upright."""
    # the farthest that a taxel touches; a mug's handle is no part of its outline
    reach_m = float(np.hypot(*np.abs(model.scene.extent).max(axis=0))) + model.layout.radius_m

    def pressed(seen: Poses, _sag_m: Floats, _turn: Floats = UPRIGHT) -> Floats:
        near = seen[np.hypot(seen[:, 0], seen[:, 1]) <= reach_m]  # of most of a path there is none
        if not len(near):
            return np.zeros(len(model.layout))
        return np.asarray(model.activation(near).max(axis=0))

    return pressed


def drawn(pair: Pair, normal: Floats | float) -> Floats:
    """Values of a lognormal of a median and a 90th percentile, at standard normals of any shape."""
    median, p90 = pair
    rate = np.log(p90 / median) / P90 if median else 0.0
    return np.asarray(median * np.exp(rate * np.clip(normal, -FARTHEST, FARTHEST)))


class PerPress:
    """A property that is a taxel's own in half of its variance, and in the other half a press's,
    the same for all taxels: the recordings do not tell the two apart, so the halves are assumed."""

    def __init__(self, pair: Pair, taxels: int, rng: np.random.Generator) -> None:
        self._pair, self._rng = pair, rng
        self._own = rng.standard_normal(taxels)
        self.draw()

    def draw(self) -> None:
        """Another press."""
        press = self._rng.standard_normal()
        self.now = drawn(self._pair, np.sqrt(0.5) * (self._own + press))  # (M,)


class Foam:
    """Hysteresis and residue: readings (M,) in shares of full scale, scan by scan.

    Hysteresis: while a press deepens, the reading itself is read; while it recedes, more by the
    taxel's share of it. This loop closes, does not depend on speed, and is zero at 0 (after Dahl's
    model of friction).

    Residue: a share of a press stays when it is over. It is the sum of two parts, one soon gone and
    one long felt, each with the share of this taxel and press. While a part is below its share of
    what is read it grows towards it with the time constant `loading_s`, so a tap leaves less and
    what presses leave adds up, but never beyond the share; else it decays with its own.
    """

    def __init__(self, config: MeshConfig, taxels: int, rng: np.random.Generator) -> None:
        self._loop = drawn(config.hysteresis, rng.standard_normal(taxels))
        pairs = config.residue, config.residue_slow
        self._share = [PerPress(pair, taxels, rng) for pair in pairs]
        self._fading_s = np.array([[config.residue_s], [config.residue_slow_s]])
        self._loading_s = config.loading_s
        self._left = np.zeros((2, taxels))
        self._reading, self._receding = np.zeros((2, taxels))
        self._t = np.inf

    def press(self, reading: Floats, t: float) -> Floats:
        """Readings (M,) of the foam at time t [s] for ideal readings (M,); times do not go back."""
        step = reading - self._reading
        self._receding = np.clip(self._receding - step / TURN, 0.0, 1.0)
        target = np.stack([share.now for share in self._share]) * reading
        rate_s = np.where(target > self._left, self._loading_s, self._fading_s)
        self._left += (target - self._left) * -np.expm1(-max(t - self._t, 0.0) / rate_s)
        self._reading, self._t = reading, t
        held = reading * (1.0 + self._loop * self._receding)
        return np.asarray(np.maximum(held, self._left.sum(axis=0)))

    @property
    def is_felt(self) -> bool:
        """Whether the last scan was of a press, or anything stays of earlier ones."""
        return bool(self._reading.any() or self._left.any())

    def end(self) -> None:
        """A press is over: the next one has shares of its own."""
        for share in self._share:
            share.draw()


def onsets(config: MeshConfig, taxels: int, rng: np.random.Generator) -> Floats:
    """(M,) of taxels' responses, as of `taxeld.model.response`: a harder press reads more."""
    onset = drawn(config.onset, rng.standard_normal(taxels))
    room = np.diff(response(GRID, config.bend, np.zeros(1))) - LEAST_SLOPE * np.diff(GRID)
    turn = np.diff(deviation(GRID))
    least, most = -(room / turn)[turn > 0.0].min(), (room / -turn)[turn < 0.0].min()
    return np.asarray(np.clip(onset - 1.0, min(least, 0.0), max(most, 0.0)))


def cross_talk(layout: Layout, pair: Pair, rng: np.random.Generator) -> Floats:
    """(M, M) the share of a press that each other taxel of its module reads.

    They add up, as currents do. So what is read falls while all presses fade, whichever of them
    then is the strongest.
    """
    normal = rng.standard_normal((len(layout), len(layout)))
    share = drawn(pair, np.tril(normal) + np.tril(normal, -1).T)
    module = layout.uid >> 4
    share[module[:, None] != module] = 0.0
    np.fill_diagonal(share, 0.0)
    return share


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
        self._bend, self._onset = skin.bend, onsets(skin, taxels, own)
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
        self._answers, self._silence = np.ones(taxels), rng.spawn(1)[0]
        if (share := ALIKE * given.answers) < ALIKE:
            self._answers = self._silence.beta(share, ALIKE - share, taxels)
        self._silent = self._silence.random(taxels) >= self._answers

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
            onset=self._onset,
            onset_sd=zeros,
            noise_counts=given.skin.noise_counts[0] + zeros,
            frozen=zeros > 0.0,
            answers=self._answers,
        )

    def press(self, seen: Poses, t: float, turn: Floats = UPRIGHT) -> Floats:
        """(M,) counts of presses, with objects at poses (K, 3) in the upright sensor frame, in
        which the link is turned by `turn` (3, 3), at t [s]; times do not go back."""
        was_pressed = self.depth.any()
        self.depth = self._body(seen, self._sag_m.now, turn)
        if was_pressed and not self.depth.any():
            self._sag_m.draw()
            self._foam.end()
            self._silent = self._silence.random(len(self.depth)) >= self._answers
        if not self.depth.any() and not self._foam.is_felt:
            return np.zeros(len(self.depth))
        ideal = response(self.depth, self._bend, self._onset)
        counts = self.full_scale * self._foam.press(ideal, t)
        counts += self._cross_talk @ counts
        counts[self._silent] = 0.0
        return counts

    def counts(self, seen: Poses, t: float, *, touching: bool, turn: Floats = UPRIGHT) -> list[int]:
        """One scan, channel by channel, as of `press`; 0 where a taxel is dead. `touching`: whether
        the first touch has begun."""
        press = self.press(seen, t, turn)
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
