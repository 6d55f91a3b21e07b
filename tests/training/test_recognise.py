"""Which of several objects is felt: figures, experiment, and what a build says is alike."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.layout import read as layouts
from taxeld.proposals import bundle
from taxeld_training.cli import main
from taxeld_training.filters import identities, recognise
from taxeld_training.filters.identities import UNKNOWN, Identities
from tests.rig.commands import refused

from . import rig
from .rig import evaluate, rows, written_at

pytestmark = pytest.mark.check

TOUCHES = 8
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


def test_an_estimate_of_another_object_is_neither_right_nor_found_and_misleads_if_it_is_sure() -> (
    None
):
    one = given((0, [0.9], 0.99), (0, [0.2], 0.99), (1, [0.2], 0.5))
    found = identities.after(one, 1)
    assert (found["right"], found["found"]) == (0.6667, 0.6667)
    assert (found["found_and_sure"], found["misleading"]) == (0.3333, 0.3333)
    assert found["p_true"] == pytest.approx((0.9 + 0.2 + 0.72) / 3, abs=1e-4)


def test_far_from_the_right_object_is_right_but_not_found() -> None:
    one = given((0, [0.9], 0.99))
    one.error_mm[:] = 10.1
    found = identities.after(one, 1)
    assert (found["right"], found["found"], found["misleading"]) == (1.0, 0.0, 1.0)


@pytest.mark.parametrize(("unknown", "area"), [(0.1, 1.0), (0.9, 0.5), (0.99, 0.0)])
def test_unknown_objects_are_told_apart_by_the_probability_of_none(
    unknown: float, area: float
) -> None:
    one = given((0, [0.9], 0.5), (0, [0.9], 0.5), (UNKNOWN, [unknown], 0.5))
    assert identities.told_apart(one, 1) == area


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


def test_cost_is_the_ratio_of_medians_of_the_first_second_and_later_touches() -> None:
    several_ms = np.array([[9.0, 8.0, 0.0, 0.0, 0.0, 2.0, 2.0, 200.0]] * 3)
    found = identities.cost(several_ms, np.ones((3, 8)))
    ratios = found["first_ratio"], found["second_ratio"], found["settled_ratio"]
    assert ratios == (9.0, 8.0, 2.0)


def test_recognise_has_rows_of_known_and_unknown_objects_and_goes_on_where_it_was_cut(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recognise, "SKINS", ("exact",))
    few = ("--seeds", "1")
    assert evaluate("recognise", f"{block},025_mug", tmp_path, *few) == 0
    found = rows(tmp_path, "recognise")
    mine = [row for row in found if (row["of"], row["skin"]) == (recognise.TEN, "exact")]
    of: dict[str, list[dict[str, Any]]] = {}
    for row in mine:
        of.setdefault(row["figure"], []).append(row)
    assert {"identity", "cost", "calibration", "unknown"} <= of.keys()
    assert {row["object"] for row in of["identity"]} == {"all", str(block), "025_mug"}
    assert [row["contact"] for row in of["identity"][:TOUCHES]] == list(range(1, TOUCHES + 1))
    assert [row["contact"] for row in of["unknown"] if "contact" in row] == list(recognise.TOLD)
    others = {row["figure"] for row in found if row["of"] == recognise.OTHER_TEN}
    assert "unknown" not in others  # only the first filter meets them
    before = written_at(tmp_path / "memory")
    assert evaluate("recognise", f"{block},025_mug", tmp_path, *few) == 0
    assert written_at(tmp_path / "memory") == before


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
