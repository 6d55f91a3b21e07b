"""`taxeld-train build`, small: the daemon loads what it makes."""

import contextlib
import io
import json
import re
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.estimator.scans import noise_of
from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_sim.integrity import Claims
from taxeld_sim.objects import meshes
from taxeld_training import candidates, closing, progress
from taxeld_training.build import summary
from taxeld_training.cli import main
from taxeld_training.models import dataset, variants
from tests.rig.clocks import until
from tests.rig.commands import refused, refuses

from . import rig

pytestmark = pytest.mark.check

SKIN = "cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015"
THREE, THIN = (f"cylinder:rows={k},columns=12,radius_m=0.03,pitch_m=0.02" for k in (3, 2))
DEPTH_M = 0.003
Info = dict[str, Any]  # of bundle.json


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("build")
    mesh = rig.box()
    mesh.invert()
    mesh.export(place / "block.stl")
    small = ["--effort", "0.01", "--depth-mm", f"{1e3 * DEPTH_M:g}", "--ddpm", "--foam", "poor"]
    where = ["--layout", SKIN, "--out", str(place / "block")]
    out, errors, ddpm = io.StringIO(), io.StringIO(), variants.diffusion()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "CONTACTS_OF", (5000, 0))
        patch.setattr(closing, "FEW", 2)
        short = replace(ddpm, network=replace(ddpm.network, steps=8))  # 100 are slow to export
        patch.setattr(variants, "diffusion", lambda: short)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
            assert main(["build", str(place / "block.stl"), *where, *small]) == 0
    (place / "out").write_text(out.getvalue(), encoding="utf-8")
    (place / "errors").write_text(errors.getvalue(), encoding="utf-8")
    return place / "block"


@pytest.fixture
def info(built: Path) -> Info:
    return json.loads((built / "bundle.json").read_text(encoding="utf-8"))  # type: ignore[no-any-return]


def test_the_bundle_says_of_what_it_is_made_and_how_good_it_is(built: Path, info: Info) -> None:
    """On the foam that was asked for, with as many trials as it says, beside the table."""
    # the copy of the mesh is for the harness, and the daemon never reads it
    assert (built / info["mesh"]).read_bytes() == (built.parent / "block.stl").read_bytes()
    assert info["files"].keys() == {p.name for p in built.iterdir()} - {"bundle.json", info["mesh"]}
    assert [one["name"] for one in info["samplers"]] == ["density-64", "ddpm-8"]
    assert info["auto"] == ["table", "density-64"]
    assert "filter" not in info, "too few trials choose none"
    told = info["touches"]
    assert (told["foam"], told["trials"]) == ("poor", 2)
    for rule in ("found_and_sure", "misleading"):
        assert list(told[rule]) == ["table 100..400", "density-64 100..400"]
        assert np.shape([*told[rule].values()]) == (2, 8)


def test_a_build_prints_its_stages_what_it_made_how_good_and_what_to_do_next(built: Path) -> None:
    lines = (built.parent / "errors").read_text(encoding="utf-8").splitlines()
    done = [line.split(":")[0] for line in lines if re.match(r"\d/\d .*: \d+ s$", line)]
    assert done == ["1/4 scene", "2/4 contacts", "3/4 training", "4/4 trials"]
    text = (built.parent / "out").read_text(encoding="utf-8")
    heads = [line[:11].strip() for line in text.splitlines() if not line.startswith(" ")]
    assert heads == ["made", "samplers", "how good", "next", "took"]
    assert f"taxeld-hil run demo --object {built} --layout {SKIN} --out block_demo" in text


def test_a_long_stage_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "MUTE_S", 0.01)
    said = io.StringIO()
    with progress.shown(("scene", "training"), said) as tell:
        tell("scene", 1.0)
        tell("scene", 1.0)  # who has done its work may say so twice
        until(lambda: "2/2 training: 0% after" in said.getvalue())
        tell("training", 0.5)
        until(lambda: "2/2 training: 50% after" in said.getvalue())
    assert said.getvalue().splitlines().count("1/2 scene: 0 s") == 1


def test_trials_choose_the_filter_that_the_daemon_runs(
    built: Path, info: Info, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closing, "ENOUGH", 2)
    monkeypatch.setattr(closing, "SIZES", (25, 50, 100))
    monkeypatch.setattr(closing, "WORKERS", 1)
    told = closing.counted(built, SKIN, "exact", 2, lambda *_: None)
    filters, found = closing.tried("density-64", 2), told["touches"]["found_and_sure"]
    assert list(found) == list(filters)
    assert sorted(told["auto"]) == sorted(info["auto"])
    keys = told["filter"]
    name = f"{told['auto'][0]} {keys['particles']}..{keys['particles_max']}"
    assert filters[name].injected == keys["injected"]
    said = "\n".join(summary(built, info | told, SKIN))
    own, table = (found[f"{proposal} 100..400"][5] for proposal in ("density-64", "table"))
    assert f"after 6: with density-64 {own} of 2, with the table {table}\n" in said
    assert f"enough     {name} particles, {keys['injected']} samples: {found[name][5]} of 2" in said


@pytest.mark.parametrize(
    ("of_box", "median", "most", "left"),
    [
        # parted after 4: it was in doubt again
        ([[0.5, 0.999, 0.5, 0.999], [0.5, 0.999, 0.999, 0.999]], 2, 4, 0.0),
        ([[0.5, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.999]], 4, None, 0.5),
    ],
)
def test_a_pair_is_parted_once_the_touched_one_stays_likely_to_the_end(
    of_box: list[list[float]], median: int, most: int | None, left: float
) -> None:
    first = np.array(of_box)
    told = closing.parting(np.stack([first, 0.9 * (1.0 - first)], axis=2), 0, 1)
    assert (told["median"], told["q90"], told["not_parted"]) == (median, most, left)
    assert told["alike"] == (left >= 0.5)


HARD = np.random.default_rng(0).uniform(0.3, 0.9, 40)  # trials are hard for all filters alike
NOISY = HARD + np.random.default_rng(1).normal(0.0, 0.2, 40)


@pytest.mark.parametrize(
    ("worths", "usual", "chosen"),
    [
        ([HARD - 0.2, HARD - 0.005, HARD], 2, 1),
        ([NOISY, HARD, HARD + 0.3 * (NOISY - HARD)], 1, 1),
        ([HARD - 0.2, HARD, HARD + 0.1], 1, 2),
    ],
    ids=["a cheap one keeps up", "trials do not tell them apart", "a dear one is shown better"],
)
def test_the_first_filter_as_good_as_the_best_is_enough(
    worths: list[np.ndarray], usual: int, chosen: int
) -> None:
    assert closing.enough(worths, usual) == chosen


def claims(*each: list[tuple[float, float]]) -> Claims:
    """Of trials with touches as (p, error [mm])."""
    p, error_mm = np.moveaxis(np.array(each), -1, 0)
    return Claims(p, np.full(p.shape, 9.0), error_mm)


GOOD, DOUBTED, WRONG = (1.0, 1.0), (0.5, 1.0), (1.0, 99.0)
LATE = claims(*[[DOUBTED, *[GOOD] * 7]] * 10)


def test_being_sure_and_wrong_once_weighs_more_than_being_sure_earlier() -> None:
    early = claims(*[[GOOD] * 8] * 9, [*[GOOD] * 7, WRONG])
    assert closing.worth(early).mean() < closing.worth(LATE).mean()


@pytest.mark.parametrize(("early", "chosen"), [(1, "table"), (8, "density-64")])
def test_a_sampler_serves_where_it_is_shown_to_be_better_than_the_table(
    early: int, chosen: str
) -> None:
    filters, trials = closing.tried("density-64", closing.ENOUGH), [[GOOD] * 8] * early
    told = dict.fromkeys(filters, LATE)
    told["density-64 100..400"] = claims(*trials, *[[DOUBTED, *[GOOD] * 7]] * (10 - early))
    made = closing.chosen(filters, told, ["table", "density-64"])
    assert (made["auto"][0], sorted(made["auto"])) == (chosen, ["density-64", "table"])


def test_the_daemon_loads_a_built_bundle_of_its_depth_and_samples_from_it(built: Path) -> None:
    skin = layouts.load(SKIN)
    loaded = bundle.load(str(built), skin, DEPTH_M)
    assert loaded.model.scene.symmetry == 2
    refuses(f"was built for {DEPTH_M:g}", bundle.load, str(built), skin, 0.005)
    z, live = np.where(np.arange(16) == 5, 0.8, 0.0), np.ones(16, dtype=bool)
    for sampler in loaded.manifest.samplers:
        proposal = loaded.proposal(sampler.name)
        assert proposal.name == sampler.kind
        drawn = [proposal.propose(z, live, 40, np.random.default_rng(7)) for _ in range(2)]
        assert drawn[0].shape == (40, 3)
        assert np.isfinite(drawn[0]).all()
        assert np.array_equal(*drawn)


@pytest.mark.parametrize(("name", "most"), [("box", 1.84e6), ("mug", 1.84e6), ("drill", 3e5)])
def test_a_shipped_bundle_is_small_names_its_origin_and_has_learned_what_the_filter_expects(
    name: str, most: float
) -> None:
    """In its own words, and in those of each sampler's file."""
    path = bundle.find(name)
    assert sum(file.stat().st_size for file in path.iterdir()) < most
    found = bundle.manifest_of(name)
    assert "CC BY 4.0" in (found.attribution or "")
    assert found.noise == (dataset.LEARNED if found.samplers else {})
    assert asdict(noise_of(FilterConfig())).items() <= dataset.LEARNED.items()
    for one in found.samplers:
        said = {p.key: json.loads(p.value) for p in onnx.load(path / one.file).metadata_props}
        assert said["noise"] == dataset.LEARNED
    if found.samplers:
        assert found.touches, "trials chose its filter"
        assert found.filter.keys


@pytest.mark.parametrize(
    ("kept", "place", "why"),
    [
        ("thesis.tex", "", "is a directory with other content; name an empty one"),
        ("box/notes/thesis.tex", "box", "is a directory with other content; name an empty one"),
        ("thesis.tex", "thesis.tex", "cannot be written (Not a directory); name another directory"),
    ],
)
def test_a_place_that_no_bundle_can_take_is_refused_before_anything_is_built(
    kept: str, place: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bundle there may be replaced, but nothing else."""
    shutil.copytree(bundle.find("box"), tmp_path / "box")
    work = tmp_path / kept
    work.parent.mkdir(exist_ok=True)
    work.write_text("years of work", encoding="ascii")
    monkeypatch.setattr(meshes, "find", pytest.fail)
    said = refused("build", "003_cracker_box", "--out", tmp_path / place, main=main)
    assert said.startswith(f"taxeld-train: --out: {tmp_path / place} {why}")
    assert work.read_text(encoding="ascii") == "years of work"


@pytest.fixture
def box(tmp_path: Path) -> Path:
    return Path(shutil.copytree(bundle.find("box"), tmp_path / "box"))


def test_sealing_names_the_files_as_they_are_and_changes_no_sound_bundle(box: Path) -> None:
    skin, about = layouts.load(SkinConfig().layout), box / "bundle.json"
    before = json.loads(about.read_text(encoding="utf-8"))
    other = dict.fromkeys(before["files"], "0" * 64)
    about.write_text(json.dumps(before | {"files": other}), encoding="utf-8")
    refuses("is damaged or was changed", bundle.load, str(box), skin, 0.005)
    for _ in range(2):
        assert main(["seal", str(box)]) == 0
        assert bundle.load(str(box), skin, 0.005).files
        assert json.loads(about.read_text(encoding="utf-8")) == before


@pytest.mark.parametrize("text", ["", "[]", '{"format": 1}', '{"format": 2}', "[" * 100_000])
def test_what_is_no_bundle_is_not_sealed(box: Path, text: str) -> None:
    (box / "bundle.json").write_text(text, encoding="utf-8")
    refused("seal", box, main=main)
    assert (box / "bundle.json").read_text(encoding="utf-8") == text


@pytest.fixture
def solids(tmp_path: Path) -> Path:
    """Two boxes that differ above the skin, and one far shorter than the skin's heights."""
    for name, height_m in (("tall", 0.1), ("short", 0.085), ("flat", 0.01)):
        rig.box(z=height_m).export(tmp_path / f"{name}.stl")
    return tmp_path


def test_boxes_that_differ_only_above_the_skin_are_alike_and_a_mug_is_not(
    solids: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(closing, "ENOUGH", 2)
    monkeypatch.setattr(closing, "WORKERS", 1)
    objects = [str(solids / "tall.stl"), str(solids / "short.stl"), "025_mug"]
    asked = ["--layout", rig.RING, "--table", "--foam", "exact", "--out", str(solids / "made")]
    assert main(["build", *objects, *asked]) == 0
    said = capsys.readouterr().out.splitlines()
    told = json.loads((solids / "made" / "alike.json").read_text(encoding="utf-8"))
    alike = {(row["object"], row["other"]) for row in told["pairs"] if row["alike"]}
    assert alike == {("tall", "short"), ("short", "tall")}
    assert [line for line in said if line.startswith("alike")] == [
        "alike      short and tall: 8 touches at these heights leave both possible in 100% of 2 "
        "trials on exact foam"
    ]
    folders = [solids / "made" / name for name in ("tall", "short", "025_mug")]
    assert said[-1] == f"scene.bundles = {json.dumps([*map(str, folders)])}"
    assert {line.split()[0] for line in said} == {"made", "alike", "parts", "took", "scene.bundles"}


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("003_cracker_box --foam scene", "--foam: no foam 'scene'; there are exact, typical, poor"),
        ("003_cracker_box --effort 0", "--effort: must be over 0 and at most 100, not 0"),
        ("003_cracker_box --depth-mm 51", "--depth-mm: must be 0.1..50, not 51"),
        (
            f"003_cracker_box --layout {THIN} --layout {THIN} --height-m 0.02 --height-m 0.05",
            "--height-m: 2 heights for 3 layouts; give one for all, or one for each --layout",
        ),
        ("tall.stl tall.stl", "OBJECT: 'tall' 2 times; name each object once"),
        (" ".join(f"{k}.stl" for k in range(40)), "OBJECT: 40 objects; name 16 at most"),
        ("tall.stl flat.stl", "flat.stl: no taxel is at a height of the object"),
        ("tall.stl 999_none", "999_none: no such YCB object"),
        ("tall.stl short.stl --out box", "--out: box is a bundle; name a directory for several"),
    ],
)
def test_what_cannot_be_built_is_refused_before_any_training(
    solids: Path, words: str, line: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(bundle.find("box"), solids / "box")
    monkeypatch.chdir(solids)
    monkeypatch.setattr(candidates, "make", pytest.fail)
    asked = ["build", "--layout", rig.RING, "--out", "made", *words.split()]
    assert line in refused(*asked, main=main)
    assert not list(solids.glob("made/*"))


def test_a_table_alone_is_built_and_each_link_has_the_object_at_the_heights_of_its_layout(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    linked = tmp_path / "my mug"
    words = ["build", "025_mug", "--layout", THREE, "--layout", THIN, "--table"]
    heights = ["--height-m", "0.02", "--height-m", "0.05"]
    assert main([*words, *heights, "--out", str(linked)]) == 0
    printed, said = capsys.readouterr()
    assert re.match(r"1/1 scene: \d+ s\n", said)
    heads = [line.split("  ")[0] for line in printed.splitlines()]
    assert heads == ["made", "how good", "next", "took"]
    assert f"how good   taxeld-hil expect --object '{linked}'\n" in printed
    three, thin = layouts.load(THREE), layouts.load(THIN)
    first, second = bundle.load(str(linked), three, further=[thin]).model.links
    assert (len(first.scene.heights), len(second.scene.heights)) == (3, 2)
    assert second.layout is thin
    assert first.scene.symmetry == second.scene.symmetry
    assert np.array_equal(first.scene.centre, second.scene.centre)
    one, two = bundle.load(str(linked), three, further=[three]).model.links
    assert np.array_equal(one.scene.slices, two.scene.slices)
    alone = bundle.load(str(linked), thin)
    assert (len(alone.model.links), alone.manifest.height_m, alone.order) == (1, 0.05, ("table",))
    refuses(
        r"^[^\n]* a --layout for each[^\n]*$",
        bundle.load,
        str(linked),
        three,
        further=[layouts.load(SKIN)],
    )
