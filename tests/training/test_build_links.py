"""A bundle for several links: one scene a link, of one object."""

from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_training import cli

pytestmark = pytest.mark.check

RING = "cylinder:rows=3,columns=12,radius_m=0.04,pitch_m=0.015"
THIN = "cylinder:rows=2,columns=8,radius_m=0.03,pitch_m=0.02"
OTHER = "cylinder:rows=2,columns=9,radius_m=0.03,pitch_m=0.02"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mug and a can, which is round at any height, without samplers."""
    out = tmp_path_factory.mktemp("links") / "bank"
    words = ["build", "025_mug", "002_master_chef_can", "--layout", RING, "--layout", THIN]
    heights = ["--height-m", "0.02", "--height-m", "0.05"]
    assert cli.main([*words, *heights, "--trials", "1", "--out", str(out)]) == 0
    return out / "025_mug"


def test_each_link_has_the_object_at_its_own_heights(built: Path) -> None:
    ring, thin = layouts.load(RING), layouts.load(THIN)
    first, second = bundle.load(str(built), ring, further=[thin]).model.links
    assert len(first.scene.heights) == 3
    assert len(second.scene.heights) == 2
    assert second.layout is thin
    assert first.scene.symmetry == second.scene.symmetry
    assert np.array_equal(first.scene.centre, second.scene.centre)


def test_a_bundle_serves_any_one_of_its_links(built: Path) -> None:
    found = bundle.load(str(built), layouts.load(THIN))
    assert len(found.model.links) == 1
    assert found.manifest.height_m == 0.05


def test_links_of_one_layout_share_its_scene(built: Path) -> None:
    ring = layouts.load(RING)
    one, two = bundle.load(str(built), ring, further=[ring]).model.links
    assert np.array_equal(one.scene.slices, two.scene.slices)


def test_a_layout_without_a_scene_is_refused_with_the_cure(built: Path) -> None:
    ring, other = layouts.load(RING), layouts.load(OTHER)
    with pytest.raises(SetupError, match="a --layout for each") as raised:
        bundle.load(str(built), ring, further=[other])
    assert "\n" not in str(raised.value)


def test_heights_are_one_or_as_many_as_layouts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["build", "025_mug", "--layout", RING, "--layout", THIN, "--layout", OTHER]
    heights = ["--height-m", "0.02", "--height-m", "0.05"]
    assert cli.main([*words, *heights, "--out", str(tmp_path / "mug")]) == 2
    assert "--height-m: 2 heights for 3 layouts" in capsys.readouterr().err
