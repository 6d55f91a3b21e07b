"""`taxeld-train build`, small: what it makes is what the daemon loads."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from taxeld import bundle, layout
from taxeld_training.build import choose
from taxeld_training.cli import main

SKIN = "cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("build")
    mesh = trimesh.creation.box((0.06, 0.1, 0.1))
    mesh.invert()
    mesh.export(place / "block.stl")
    arguments = ["build", str(place / "block.stl"), "--skin", SKIN, "--out", str(place / "block")]
    small = ["--effort", "0.01", "--contacts", "5000", "--bank", "5000"]
    assert main(arguments + small) == 0
    return place / "block"


def test_the_daemon_loads_and_samples_it(built: Path) -> None:
    skin = layout.load(SKIN)
    loaded = bundle.load(str(built), skin, 0.005)
    assert loaded.info["symmetry"] == 2
    rng = np.random.default_rng(0)
    z = np.zeros(16)
    z[5] = 0.8
    for sampler in loaded.info["samplers"]:
        proposal = loaded.proposal("auto", sampler["name"])
        assert proposal.name == sampler["kind"]
        poses = proposal.propose(z, np.ones(16, dtype=bool), 40, rng)
        assert poses.shape == (40, 3)
        assert np.isfinite(poses).all()
        again = proposal.propose(z, np.ones(16, dtype=bool), 40, np.random.default_rng(7))
        same = proposal.propose(z, np.ones(16, dtype=bool), 40, np.random.default_rng(7))
        assert np.array_equal(again, same)


def test_each_sampler_says_what_it_costs_and_how_good_it_is(built: Path) -> None:
    info = json.loads((built / "bundle.json").read_text(encoding="utf-8"))
    assert {s["name"] for s in info["samplers"]} == {
        "density-64",
        "density-16",
        "ddpm-100",
    }
    for measured in [*info["samplers"], *info["analytic"].values()]:
        assert measured["energy_distance"] > 0
        assert measured["ms"] > 0
    assert all(sampler["flops"] > 0 for sampler in info["samplers"])
    assert "exact draws" in info["measured"]


def test_the_daemons_order_begins_with_the_cheapest_that_is_as_good_as_the_best() -> None:
    candidates = {
        "dear": {"energy_distance": 0.100, "ms": 9.0},
        "cheap": {"energy_distance": 0.114, "ms": 0.2},
        "bad": {"energy_distance": 0.300, "ms": 0.1},
        "worst": {"energy_distance": 0.900, "ms": 0.1},
    }
    chosen = choose(candidates, 1.15)
    assert chosen["order"] == ["cheap", "dear", "bad", "worst"]
    assert "cheap" in chosen["why"]
    assert "1.15" in chosen["why"]
    assert choose(candidates, 1.1)["order"] == ["dear", "cheap", "bad", "worst"]
    assert choose(candidates, 4.0)["order"][0] == "bad"


def test_the_bundle_records_repairs_and_the_grids_error(built: Path) -> None:
    info = json.loads((built / "bundle.json").read_text(encoding="utf-8"))
    assert info["repairs"] == ["turned 12 faces outward"]
    assert info["grid_error_mm"].keys() == {"rms", "p99", "max"}
    assert 0.0 < info["grid_error_mm"]["rms"] < info["grid_error_mm"]["max"] < 1.0


def test_a_directory_of_other_things_is_not_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="ascii")
    assert main(["build", "003_cracker_box", "--out", str(tmp_path)]) == 2
    assert "other content" in capsys.readouterr().err
    assert (tmp_path / "thesis.tex").exists()


def test_shipped_bundles_are_small_and_name_their_origin() -> None:
    for name in ("box", "mug"):
        path = bundle.find(name)
        assert sum(file.stat().st_size for file in path.iterdir()) < 2_000_000
        info = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
        assert "CC BY 4.0" in info["attribution"]
