"""The layouts of real skins, where they lie beside this checkout."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands.layout import arc_rad, pitch_m, tilted
from taxeld.layout import read as layouts

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data"
REAL = DATA / "layouts"


@pytest.mark.skipif(not REAL.is_dir(), reason="the real layouts are not beside this checkout")
class TestReal:
    @pytest.mark.parametrize(
        ("name", "taxels", "modules", "radius_mm", "arc_deg", "height_mm"),
        [
            ("ur10e_link1_patch1", 642, 60, 72.0, 181.0, 130.0),
            ("ur10e_link2_patch1", 524, 51, 63.0, 178.0, 147.0),
        ],
    )
    def test_arm_links_are_half_cylinders(
        self, name, taxels, modules, radius_mm, arc_deg, height_mm
    ):
        skin = layouts.load(str(REAL / f"{name}.json"))
        assert len(skin) == taxels
        assert len(np.unique(skin.uid >> 4)) == modules
        assert skin.radius_m * 1e3 == pytest.approx(radius_mm, abs=2.0)
        assert skin.rms_m * 1e3 < 2.5
        assert math.degrees(arc_rad(skin)) == pytest.approx(arc_deg, abs=1.0)
        assert np.ptp(skin.position_m[:, 2]) * 1e3 == pytest.approx(height_mm, abs=1.0)
        assert 6.0 < pitch_m(skin) * 1e3 < 8.0
        assert (skin.source.unit, skin.turned, tilted(skin)) == ("m", 0, 0)
        assert len(skin.turns) == 1
        angle = np.arctan2(skin.position_m[:, 1], skin.position_m[:, 0])
        assert angle.min() == pytest.approx(-angle.max(), abs=0.02)
        axis = skin.frame[2, :3]
        assert axis @ [0.0, 1.0, 0.0] > 0.999_999

    @pytest.mark.parametrize(("name", "missing"), [("cyskin_full", 0), ("tpu_1_full", 2)])
    def test_hexagons_are_flat(self, name, missing):
        skin = layouts.read(str(REAL / f"hexagon_{name}_isomap.json"))
        assert len(skin) + missing == 61
        assert skin.source.missing == missing
        assert math.isinf(skin.radius_m)
        assert np.ptp(skin.position_m[:, 2]) == 0.0
        assert pitch_m(skin) * 1e3 == pytest.approx(6.928, abs=0.001)
