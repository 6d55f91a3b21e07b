"""A soft skin of the harness between true activations and what is read.

The harness presses a mesh against points of a cover. Here a trial's own activations are pressed in,
so that thousands of trials are affordable: the cover sags from taxel to taxel. Figures, responses,
foam and cross-talk are the harness's own (docs/physics.md).
"""

import numpy as np

from taxeld.arrays import Bools, Floats
from taxeld.config.tables import SkinConfig
from taxeld.layout.layout import Layout
from taxeld.model.activation import FLOOR
from taxeld.skin.foam import Residue
from taxeld_hil.scenario.mesh_config import MeshConfig
from taxeld_hil.world.electronics import CrossTalk, Response
from taxeld_hil.world.foam import Foam
from taxeld_hil.world.spread import PerPress, drawn

SILENT = 6.0  # standard deviations of a taxel's noise: less is no touch to a daemon


class SoftSkin:
    """One skin: what its taxels have drawn lasts; what a press draws ends with it."""

    def __init__(
        self, config: MeshConfig, layout: Layout, gain: Floats, rng: np.random.Generator
    ) -> None:
        """`gain` (M,) of each taxel."""
        m = len(layout)
        self._gain, self._rng = gain, rng
        self._apart_m = np.linalg.norm(layout.position_m[:, None] - layout.position_m, axis=-1)
        self._sag_m = PerPress(config.sag_m, m, rng)
        self._response = Response(config, m, rng)
        self._foam = Foam(config, m, rng)
        self._cross_talk = CrossTalk(layout, config.cross_talk, rng)
        noise_counts = drawn(config.noise_counts, rng.standard_normal(m))
        self._noise = noise_counts / SkinConfig().full_scale_counts
        self._kept = Residue(m)
        self._is_pressed = False
        self.floor, self.residue = np.zeros((2, m))  # the last activation's

    def read(self, h: Floats, t: float) -> tuple[Floats, Bools]:
        """Activations z (M,), with noise, for true ones h (M,) at t [s]; and which (M,) a daemon's
        rule for what foam keeps takes for pressed."""
        was_pressed, self._is_pressed = self._is_pressed, bool(h.any())
        if was_pressed and not self._is_pressed:
            self._sag_m.draw()
            self._foam.end()
        sagging = (np.exp(-self._apart_m / self._sag_m.now[:, None]) * h).max(axis=1)
        reading = self._gain * self._foam.press(self._response(sagging), t)
        z = self._cross_talk.add(reading) + self._noise * self._rng.standard_normal(len(h))
        least = np.maximum(FLOOR, SILENT * self._noise)
        self._kept.on_scan(z, least)
        self.floor, self.residue = np.minimum(least + self._kept.level, 1.0), self._kept.level
        return z, self._kept.pressed
