"""Counts of a skin on a fake clock: noise, drift, temperature, presses and faults, scan by scan."""

from collections.abc import Callable, Iterator

import numpy as np

from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.observation import Activation
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module, wired

BASE, T0, NOISE = 10_000.0, 12_000.0, 34.0
PERIOD_S = 0.05
LEAK = 0.04  # share of a module's summed press that its T0 sees


class SimulatedSkin:
    """One hub. What is added to the taxels and to T0 may be a value or a function of the time."""

    def __init__(
        self,
        layout: Layout,
        seed: int = 0,
        noise: float = NOISE,
        modules: tuple[Module, ...] = (),
    ) -> None:
        """`modules`: of the hub, where they are not the layout's."""
        self.layout = layout
        self.modules = modules or tuple(wired(layout.uid.tolist()))
        self.rng = np.random.default_rng(seed)
        self.noise = noise  # sd of a reading [counts],
        self.spread = np.ones(len(layout))  # times this, taxel by taxel
        self.t = 100.0
        self.base = BASE + 500.0 * self.rng.standard_normal(len(layout))
        self.press = np.zeros(len(layout))
        self.warmth: Callable[[float], float] = lambda t: 0.0 * t
        self.coefficient = 0.0  # counts of drift a count of T0
        self.own_drift: Callable[[float], float] = lambda t: 0.0 * t
        self.fixed: dict[int, int] = {}  # taxels that read this whatever happens
        uids = [uid for module in self.modules for uid in module.uids]
        index = {int(uid): i for i, uid in enumerate(layout.uid)}
        self.taxel = np.array([index.get(uid, -1) for uid in uids])
        self.module = np.repeat(range(len(self.modules)), [m.channels for m in self.modules])

    def scan(self) -> Scan:
        """The next scan."""
        self.t += PERIOD_S
        warmth = self.warmth(self.t - 100.0)
        idle = self.base + self.coefficient * warmth + self.own_drift(self.t - 100.0)
        noise = self.noise * self.spread * self.rng.standard_normal(len(self.base))
        taxels = idle + self.press + noise
        for taxel, value in self.fixed.items():
            taxels[taxel] = value
        at = self.taxel
        leak = LEAK * np.bincount(self.module, np.where(at >= 0, self.press[at], 0.0))
        t0 = T0 + warmth + 0.2 * self.noise * self.rng.standard_normal(len(leak)) + leak
        values = np.where(at >= 0, taxels[at], t0[self.module])
        counts = np.clip(np.round(values), MISSING, 0xFFFF).astype(int).tolist()
        return Scan(self.t, 1, tuple(counts), self.modules, 1)

    def lead(self, skin: Skin, seconds: float) -> Iterator[Activation | None]:
        """What the skin makes of the next scans."""
        for _ in range(round(seconds / PERIOD_S)):
            yield skin.on_scan(self.scan())

    def run(self, skin: Skin, seconds: float) -> Activation:
        """The same; → the last activation."""
        *_, last = self.lead(skin, seconds)
        return last


def begun(
    layout: Layout, seconds: float = 2.0, seed: int = 0, noise: float = NOISE
) -> tuple[SimulatedSkin, Skin]:
    """A skin at rest, and a subject that has read it for so long."""
    simulated, subject = SimulatedSkin(layout, seed, noise), Skin(layout, SkinConfig())
    simulated.run(subject, seconds)
    return simulated, subject
