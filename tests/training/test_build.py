"""`taxeld-train build`, small: the daemon loads what it makes."""

import contextlib
import io
import json
import os
import pty
import re
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.estimator.scans import noise_of
from taxeld.layout import read as layouts
from taxeld.model.noise import Noise
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld_training.build import summary
from taxeld_training.cli import main
from taxeld_training.filters import touches
from taxeld_training.jobs import stages
from taxeld_training.limits import quality
from taxeld_training.samplers.candidates import choose
from tests.rig.commands import printed, refused
from tests.rig.processes import read_all

from . import rig

pytestmark = pytest.mark.check

SKIN = "cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015"
DEPTH_M = 0.003


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("build")
    mesh = rig.box()
    mesh.invert()
    mesh.export(place / "block.stl")
    arguments = ["build", str(place / "block.stl"), "--layout", SKIN, "--out", str(place / "block")]
    small = ["--effort", "0.01", "--contacts", "5000", "--bank", "5000", "--readings", "4"]
    small += ["--depth-mm", f"{1e3 * DEPTH_M:g}", "--ddpm", "--trials", "2", "--foam", "poor"]
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        assert main(arguments + small) == 0
    (place / "out").write_text(out.getvalue(), encoding="utf-8")
    (place / "errors").write_text(errors.getvalue(), encoding="utf-8")
    return place / "block"


@pytest.fixture
def info(built: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((built / "bundle.json").read_text(encoding="utf-8"))
    return found


def test_the_bundle_records_what_it_is_made_of_and_how_good_that_is(
    built: Path, info: dict[str, Any]
) -> None:
    # the copy of the mesh is for the harness, and the daemon never reads it
    assert (built / info["mesh"]).read_bytes() == (built.parent / "block.stl").read_bytes()
    assert info["files"].keys() == {p.name for p in built.iterdir()} - {"bundle.json", info["mesh"]}
    assert info["format"] == 3
    assert info["repairs"] == ["turned 12 faces outward"]
    assert info["grid_error_mm"].keys() == {"rms", "p99", "max"}
    assert 0.0 < info["grid_error_mm"]["rms"] < info["grid_error_mm"]["max"] < 1.0
    assert {s["name"] for s in info["samplers"]} == {"density-64", "density-16", "ddpm-100"}
    for measured in [*info["samplers"], *info["analytic"].values()]:
        assert np.isfinite(measured["energy_distance"])
        assert measured["ms"] > 0
    assert all(sampler["flops"] > 0 for sampler in info["samplers"])
    assert "exact draws" in info["measured"]


def test_a_build_that_is_piped_prints_a_line_a_stage(built: Path) -> None:
    lines = (built.parent / "errors").read_text(encoding="utf-8").splitlines()
    stages = [line for line in lines if re.match(r"\d/\d ", line)]
    assert [line.split(":")[0] for line in stages] == [
        "1/7 scene",
        "2/7 contacts",
        "3/7 training",
        "4/7 contacts to measure with",
        "5/7 exact posteriors",
        "6/7 measuring",
        "7/7 trials",
    ]
    assert all(re.search(r": \d+ s$", line) for line in stages)


def test_a_build_ends_with_what_it_made_how_good_and_what_to_do_next(built: Path) -> None:
    text = (built.parent / "out").read_text(encoding="utf-8")
    heads = [line[:11].strip() for line in text.splitlines() if not line.startswith(" ")]
    assert heads == ["made", "samplers", "how good", "next", "took"]
    assert f"made       {built}: block on {SKIN}, " in text
    assert f"taxeld-hil run demo --object {built} --layout {SKIN} --out block_demo" in text


def test_a_bundle_says_in_touches_how_good_it_is(info: dict[str, Any]) -> None:
    """On the foam that was asked for, with as many trials as it says, beside the table."""
    told = info["touches"]
    assert (told["foam"], told["trials"]) == ("poor", 2)
    for rule in ("found_and_sure", "misleading"):
        assert list(told[rule]) == ["table 100..400", f"{_sampler(info)} 100..400"]
        for counts in told[rule].values():
            assert len(counts) == 8
            assert all(0 <= count <= 2 for count in counts)


def _sampler(info: dict[str, Any]) -> str:
    """The daemon's first choice among samplers."""
    trained = {one["name"] for one in info["samplers"]}
    return next(name for name in info["auto"] if name in trained)


def test_trials_are_the_same_by_any_number_of_workers(built: Path) -> None:
    skin = layouts.load(SKIN)
    two, three = (
        touches.counted(built, skin, touches.EndTrials("poor", 2, workers=n), lambda *_: None)
        for n in (2, 3)
    )
    assert two == three


@pytest.mark.parametrize(("own", "is_cured"), [(20, True), (32, False)])
def test_the_summary_counts_trials_and_has_a_cure_where_the_table_finds_clearly_more(
    built: Path, info: dict[str, Any], own: int, is_cured: bool
) -> None:
    found = {
        "table 100..400": [0] * 5 + [34, 38, 39],
        "density-64 100..400": [0] * 5 + [own, 38, 39],
    }
    wrong = {"table 100..400": [0] * 8, "density-64 100..400": [0, 1, 1, 0, 0, 0, 0, 0]}
    told = {"foam": "typical", "trials": 40, "found_and_sure": found, "misleading": wrong}
    said = "\n".join(summary(built, info | {"touches": told}, SKIN, "the cure"))
    assert (
        f"how good   density-64 100..400: {own} of 40 found and sure after 6 touches on typical "
        "foam, 39 after 8; 2 of 320 estimates misleading\n"
        "           table 100..400: 34, 39 after 8; 0 misleading\n"
    ) in said
    assert ("\n           the cure\n" in said) == is_cured


@pytest.mark.parametrize("trials", [1, 2])
def test_trials_choose_the_filter_that_the_daemon_runs_if_there_are_enough_of_them(
    built: Path, info: dict[str, Any], trials: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(touches.enough, "LEAST", 2)
    monkeypatch.setattr(touches, "SIZES", (25, 50, 100))
    asked = touches.EndTrials("exact", trials, workers=1)
    told = touches.counted(built, layouts.load(SKIN), asked, lambda *_: None)
    if trials < 2:
        assert told.keys() == {"touches"}
        return
    filters = touches.tried(_sampler(info), asked)
    assert list(told["touches"]["found_and_sure"]) == list(filters)
    assert sorted(told["auto"]) == sorted(info["auto"])
    keys = told["filter"]
    name = f"{told['auto'][0]} {keys['particles']}..{keys['particles_max']}"
    assert filters[name].injected == keys["injected"]
    said = list(summary(built, info | told, SKIN, ""))
    assert f"enough     {name} particles, {keys['injected']} samples" in said
    assert said[3].startswith(f"how good   {name}: ")


def test_an_unknown_foam_is_refused_before_anything_is_built(tmp_path: Path) -> None:
    asked = "build", "003_cracker_box", "--foam", "scene", "--out", tmp_path / "box"
    said = refused(*asked, main=main)
    assert said == "taxeld-train: --foam: no foam 'scene'; there are exact, typical, poor\n"


def test_another_depth_is_the_bundles_and_a_daemon_must_have_it(
    built: Path, info: dict[str, Any]
) -> None:
    assert info["depth_max_m"] == DEPTH_M
    with pytest.raises(SetupError, match=f"was built for {DEPTH_M:g}"):
        bundle.load(str(built), layouts.load(SKIN), 0.005)
    scene = "scene", "003_cracker_box", "--depth-mm"
    said = printed(*scene, 3, main=main)
    assert "build 003_cracker_box --height-m 0.04 --depth-mm 3 --quick" in said
    said = refused(*scene, 51, main=main)
    assert said == "taxeld-train: --depth-mm: must be 0.1..50, not 51\n"


def test_exact_posteriors_are_the_same_by_any_number_of_workers_and_tell_their_share(
    ring_model: ObservationModel,
) -> None:
    """A long stage does not stand at its end."""
    told: list[tuple[str, float]] = []
    one, two = (
        quality.reference(
            ring_model,
            Noise(),
            4,
            np.random.default_rng(0),
            bank=60_000,
            workers=workers,
            progress=lambda stage, share: told.append((stage, share)),
        )
        for workers in (1, 2)
    )
    # A sum differs in its last digits by the threads that share it, and a worker has one
    assert one.ess == pytest.approx(two.ess, rel=1e-9)
    np.testing.assert_allclose(one.exact, two.exact, rtol=1e-9, atol=1e-12)
    for stage in (quality.BANK_STAGE, quality.EXACT_STAGE):
        shares = [share for name, share in told[: len(told) // 2] if name == stage]
        assert len(shares) > 2
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


def test_a_terminal_has_a_bar_for_each_stage_from_the_start() -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "w") as terminal, stages.shown(("scene", "training"), terminal) as tell:
        tell("scene", 1.0)
        tell("training", 0.5)
    drawn = read_all(ours)
    assert "1/2 scene" in drawn
    assert "2/2 training" in drawn
    assert "50%" in drawn


def test_the_daemon_loads_a_built_bundle_and_samples_from_it(built: Path) -> None:
    skin = layouts.load(SKIN)
    loaded = bundle.load(str(built), skin, DEPTH_M)
    assert loaded.model.scene.symmetry == 2
    rng = np.random.default_rng(0)
    z = np.zeros(16)
    z[5] = 0.8
    for sampler in loaded.manifest.samplers:
        proposal = loaded.proposal(sampler.name)
        assert proposal.name == sampler.kind
        poses = proposal.propose(z, np.ones(16, dtype=bool), 40, rng)
        assert poses.shape == (40, 3)
        assert np.isfinite(poses).all()
        again = proposal.propose(z, np.ones(16, dtype=bool), 40, np.random.default_rng(7))
        same = proposal.propose(z, np.ones(16, dtype=bool), 40, np.random.default_rng(7))
        assert np.array_equal(again, same)


def test_samplers_learn_the_errors_that_the_filter_expects(built: Path) -> None:
    expected = asdict(noise_of(FilterConfig()))
    for path in (built, bundle.find("box"), bundle.find("mug")):
        info = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
        assert info["noise"].items() <= expected.items()


def measured(mean: float, ms: float, spread: float = 0.2, readings: int = 200) -> dict[str, Any]:
    """A proposal's distances to as many readings, some of which are hard for all proposals."""
    rng = np.random.default_rng(0)
    hard = rng.lognormal(0.0, 0.5, readings)
    own = np.random.default_rng(round(1e6 * mean)).normal(1.0, spread, readings)
    distances = hard * own
    distances *= mean / distances.mean()
    return {"energy_distance": mean, "ms": ms, "distances": distances}


def test_the_daemons_order_begins_with_the_cheapest_that_is_shown_to_be_as_good_as_the_best() -> (
    None
):
    candidates = {
        "dear": measured(0.100, 9.0),
        "cheap": measured(0.105, 0.2),
        "bad": measured(0.300, 0.1),
        "worst": measured(0.900, 0.1),
    }
    chosen = choose(candidates, 1.15)
    assert chosen["order"] == ["cheap", "dear", "bad", "worst"]
    assert "cheap" in chosen["why"]
    assert "1.15" in chosen["why"]
    assert choose(candidates, 1.0)["order"] == ["dear", "cheap", "bad", "worst"]
    assert choose(candidates, 4.0)["order"][0] == "bad"


def test_what_noise_alone_makes_as_good_is_not_preferred() -> None:
    """Of few readings with errors of their own a mean within the tolerance says nothing."""
    few = {
        "dear": measured(0.100, 9.0, spread=0.6, readings=12),
        "cheap": measured(0.110, 0.2, spread=0.6, readings=12),
    }
    assert choose(few, 1.15)["order"] == ["dear", "cheap"]


def test_a_directory_with_other_content_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="ascii")
    assert "other content" in refused("build", "003_cracker_box", "--out", tmp_path, main=main)
    assert (tmp_path / "thesis.tex").exists()


def test_shipped_bundles_are_small_and_name_their_origin() -> None:
    for name, most in (("box", 2_000_000), ("mug", 2_000_000), ("drill", 300_000)):
        path = bundle.find(name)
        assert sum(file.stat().st_size for file in path.iterdir()) < most
        info = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
        assert "CC BY 4.0" in info["attribution"]


@pytest.fixture
def box(tmp_path: Path) -> Path:
    return Path(shutil.copytree(bundle.find("box"), tmp_path / "box"))


def test_sealing_a_sound_bundle_changes_nothing(box: Path) -> None:
    before = (box / "bundle.json").read_bytes()
    assert main(["seal", str(box)]) == 0
    assert (box / "bundle.json").read_bytes() == before


def test_sealing_makes_a_bundle_of_format_2_one_of_format_3(box: Path) -> None:
    skin = layouts.load(SkinConfig().layout)
    info = json.loads((box / "bundle.json").read_text(encoding="utf-8"))
    del info["files"]
    (box / "bundle.json").write_text(json.dumps(info | {"format": 2}), encoding="utf-8")
    with pytest.raises(SetupError, match="taxeld-train seal"):
        bundle.load(str(box), skin, 0.005)
    assert main(["seal", str(box)]) == 0
    assert bundle.load(str(box), skin, 0.005).files


@pytest.mark.parametrize("text", ["", "[]", '{"format": 1}', '{"format": 2}', "[" * 100_000])
def test_what_is_no_bundle_is_not_sealed(box: Path, text: str) -> None:
    (box / "bundle.json").write_text(text, encoding="utf-8")
    refused("seal", box, main=main)
    assert (box / "bundle.json").read_text(encoding="utf-8") == text
