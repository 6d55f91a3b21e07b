"""Which of several objects can be told apart, as a build says it."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_training.cli import main
from taxeld_training.filters import identities
from taxeld_training.filters.identities import Identities
from tests.rig.commands import refused

from . import rig

pytestmark = pytest.mark.check

NAMES = ("box", "mug")


def given(*runs: tuple[int, list[float], float]) -> Identities:
    """Runs as (touched object, probability of object 0 after each touch, p); the rest of the
    probability is object 1's but for a tenth of it. All errors are 5 mm."""
    true = np.array([run[0] for run in runs])
    first = np.array([run[1] for run in runs])
    objects = np.stack([first, 0.9 * (1.0 - first)], axis=2)
    named = objects.argmax(axis=2)
    p = np.array([np.full(len(run[1]), run[2]) for run in runs])
    error_mm = np.where(named == true[:, None], 5.0, np.nan)
    radius_mm = np.full(p.shape, 20.0)
    other = 1.0 - objects.sum(axis=2)
    return Identities(p, radius_mm, error_mm, true, named, objects, other)


def test_a_pair_is_parted_once_the_touched_one_stays_likely_to_the_end() -> None:
    one = given(
        (0, [0.5, 0.999, 0.5, 0.999], 0.5),  # parted after 4: it was in doubt again
        (0, [0.5, 0.999, 0.999, 0.999], 0.5),
        (1, [0.5, 0.5, 0.5, 0.5], 0.5),
        (1, [0.5, 0.5, 0.5, 0.001], 0.5),
    )
    box, mug = identities.parting(one, NAMES)
    assert (box["object"], box["other"], box["median"], box["q90"]) == ("box", "mug", 2, 4)
    assert (box["not_parted"], box["alike"]) == (0.0, False)
    assert (mug["median"], mug["q90"], mug["not_parted"], mug["alike"]) == (4, None, 0.5, True)


@pytest.fixture
def solids(tmp_path: Path) -> Path:
    """Two boxes that differ above the skin, and one far shorter than the skin's heights."""
    for name, height_m in (("tall", 0.1), ("short", 0.085), ("flat", 0.01)):
        rig.box(z=height_m).export(tmp_path / f"{name}.stl")
    return tmp_path


def test_boxes_that_differ_only_above_the_skin_are_alike_and_a_mug_is_not(
    solids: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    objects = [str(solids / "tall.stl"), str(solids / "short.stl"), "025_mug"]
    asked = ["--layout", rig.RING, "--trials", "2", "--foam", "exact", "--out", solids / "made"]
    assert main(["build", *objects, *map(str, asked)]) == 0
    said = capsys.readouterr().out
    told = json.loads((solids / "made" / "alike.json").read_text(encoding="utf-8"))
    alike = {(row["object"], row["other"]) for row in told["pairs"] if row["alike"]}
    assert alike == {("tall", "short"), ("short", "tall")}
    lines = [line for line in said.splitlines() if line.startswith("alike")]
    assert lines == [
        "alike      short and tall: 8 touches at these heights leave both possible in 100% of 2 "
        "trials on exact foam"
    ]
    folders = [solids / "made" / name for name in ("tall", "short", "025_mug")]
    assert said.splitlines()[-1] == f"scene.bundles = {json.dumps([*map(str, folders)])}"
    for folder in folders:
        opened = bundle.load(str(folder), layouts.load(rig.RING))
        assert (opened.order, opened.manifest.samplers) == (("table",), ())
        assert re.search(rf"made +{folder}: .*, 0\.\d MB", said)


@pytest.mark.parametrize(
    ("objects", "line"),
    [
        ("tall.stl tall.stl", "OBJECT: 'tall' 2 times; name each object once"),
        (" ".join(f"{k}.stl" for k in range(40)), "OBJECT: 40 objects; name 16 at most"),
        ("tall.stl flat.stl", "flat.stl: no taxel is at a height of the object"),
        ("tall.stl 999_none", "999_none: no such YCB object"),
        ("tall.stl short.stl --contacts 9", "--contacts: trains nothing of several objects; add"),
    ],
)
def test_what_cannot_be_built_together_is_refused_before_any_work(
    solids: Path, objects: str, line: str
) -> None:
    names = [str(solids / name) if name.endswith(".stl") else name for name in objects.split()]
    asked = ["build", *names, "--layout", rig.RING, "--out", solids / "made"]
    assert line in refused(*asked, main=main)
    assert not (solids / "made").exists()


def test_several_bundles_are_not_put_into_a_bundle(solids: Path) -> None:
    (solids / "made").mkdir()
    (solids / "made" / "bundle.json").write_text("{}", encoding="ascii")
    names = solids / "tall.stl", solids / "short.stl"
    said = refused("build", *names, "--out", solids / "made", main=main)
    assert (
        said
        == f"taxeld-train: --out: {solids / 'made'} is a bundle; name a directory for several\n"
    )
