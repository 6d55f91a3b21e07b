"""What is expected of a skin before it is bought: the table, what would help."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld_hil import cli
from taxeld_hil.experiment import expect
from taxeld_hil.experiment.expect import AS_IS
from taxeld_hil.scenario.staged import world_of
from taxeld_sim import jobs
from taxeld_sim.answers.played import BLOCK, Played
from taxeld_sim.trials.case import Case
from taxeld_sim.trials.play import Touch
from taxeld_sim.trials.play import world_of as world_of_case
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject, model_of
from tests.hil.rig import DEMO
from tests.rig.commands import refused
from tests.rig.skins import table_of

pytestmark = pytest.mark.check

PATCH = "cylinder:rows=2,columns=40,radius_m=0.07,pitch_m=0.015"


def played(name: str, seeds: int, *sure_from: int) -> Played:
    """Trials that are right and sure from a touch on, in turn, and before in doubt and far off."""

    def touch(number: int, seed: int) -> Touch:
        is_sure = number >= sure_from[seed % len(sure_from)]
        error_mm, p = (5.0, 1.0) if is_sure else (20.0, 0.0)
        return Touch(0, error_mm, p, 5.0, (1.0,), 0.0, 0.0, "", 100, 0.0, 0.0, 0.0)

    trials = [[touch(number, seed) for number in range(6)] for seed in range(seeds)]
    return Played({"cell": name}, ("box",), 0, tuple(range(seeds)), trials)


def test_a_change_helps_only_where_trials_of_the_same_seeds_say_so_beyond_chance() -> None:
    own = played(AS_IS, 10, 3, 9)
    changed = played("deeper foam", 10, 5), played("calibration", 10, 1)
    best, none, worst = expect.helps([own, *changed, played("larger patch", 10, 3, 9)])
    assert (best.name, best.verdict) == ("calibration", "would help")
    assert (none.name, none.verdict) == ("larger patch", "not shown to help")
    assert (worst.name, worst.verdict) == ("deeper foam", "would hurt")
    assert (best.trials, best.after) == (10, 4), "touches"
    assert best.found == best.found_and_sure == (0.5, 1.0)
    few = expect.helps([played(AS_IS, 7, 3, 9), played("calibration", 7, 1)])
    assert few[0].verdict == "too few seeds to tell"


def cases(*asked: Any) -> dict[str, Case]:
    return {str(each.labels["cell"]): each.case for each in expect.cells(*asked)}


def test_a_robot_errs_alike_throughout_a_touch_and_otherwise_in_the_next() -> None:
    made = world_of(replace(DEMO, contacts=40, robot_m=0.002), 0)
    off = [
        [made.stated(t)[:2] - made.sensor(t)[:2] for t in np.linspace(*touched, 4)]
        for touched in made.touched_s()
    ]
    np.testing.assert_allclose(np.ptp(off, axis=1), 0.0, atol=1e-12)
    assert 0.0015 < np.std(np.array(off)[:, 0]) < 0.0025
    right = world_of(DEMO, 0)
    np.testing.assert_array_equal(right.stated(3.0), right.sensor(3.0))


def test_a_skin_that_leaves_half_of_its_link_bare_is_turned_to_the_object(tmp_path: Path) -> None:
    ring, half = layouts.load(PATCH), tmp_path / "half.csv"
    head, *rows = table_of(ring).splitlines()
    kept = [row for row in rows if float(row.split(",")[0]) > 0.0]
    half.write_text("\n".join([head, *kept, ""]), encoding="ascii")
    own = cases(Subject("box"), str(half), Conditions(), 8, tmp_path)[AS_IS]
    for guide in ("around", "random"):
        made = world_of_case(replace(own, guide=guide), 0)
        assert len(made.touched_s()) == 8
        for touched in made.touched_s():
            seen = se2.compose(se2.inverse(made.sensor(float(np.mean(touched)))), made.truth)
            assert made.links[0].activation(seen[None]).max() > 0.0


def test_a_larger_patch_has_all_taxels_twice_and_stands_on_the_same_height(tmp_path: Path) -> None:
    made = cases(Subject("box"), "", Conditions(), 8, tmp_path)
    of = {name: model_of(case.subject, *case.specs) for name, case in made.items()}
    own, larger = (of[name].layout.position_m for name in (AS_IS, "larger patch"))
    assert len(larger) == 2 * len(own)
    assert of["deeper foam"].depth_max_m == 2.0 * of[AS_IS].depth_max_m
    assert of["larger patch"].scene.heights.max() == pytest.approx(larger[:, 2].max(), abs=0.006)
    assert made["larger patch"].subject.own_height_m - larger[:, 2].max() < 0.04


@pytest.mark.smoke
def test_a_small_run_prints_its_table_writes_its_files_and_is_remembered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["expect", "--object", "box", "--foam", "scene", "--seeds", "2", "--touches", "3"]
    command += ["--workers", "1", "--out", str(tmp_path)]
    assert cli.main(command) == 0
    first = capsys.readouterr()
    assert "2 trials" in first.out
    assert "\n| cell | mm after 3 | found and sure 2 | found and sure 3 | misleading |" in first.out
    assert "\n| as it is | " in first.out
    found = json.loads((tmp_path / "expect.json").read_text(encoding="utf-8"))
    assert [len(row["found"]) for row in found["rows"]] == [3] * 4
    assert {each["name"] for each in found["helps"]} < {row["of"]["cell"] for row in found["rows"]}
    assert cli.main(command) == 0
    again = capsys.readouterr()
    assert again.out == first.out
    assert again.err == ""


@pytest.mark.parametrize(("more", "seeds"), [([], 40), (["--quick"], 10)])
def test_every_seed_tries_what_would_help_and_what_that_costs_is_said_before(
    more: list[str], seeds: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(todo: list[jobs.Job], **_: object) -> None:
        raise SetupError(f"{len(todo)} jobs")

    monkeypatch.setattr(jobs, "run", stop)
    assert cli.main(["expect", "--object", "box", "--foam", "scene", *more]) == 2
    printed, jobs_begun = capsys.readouterr()
    assert jobs_begun == f"{4 * seeds // BLOCK} jobs\n"
    said = f"{4 * seeds} trials of {seeds} seeds (as it is, calibration, larger patch, deeper foam)"
    assert re.match(rf"{re.escape(said)}: \d+ minutes of a core\n", printed)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--object", "nothing"], "--object: nothing: no such YCB object"),
        (["--object", "box", "--robot-mm", "99"], "--robot-mm: must be 0..50, not 99"),
        (["--object", "box", "--depth-mm", "0"], "--depth-mm: must be 0.1..50, not 0"),
        (["--object", "box", "--height-m", "5"], "no taxel is at a height of the object"),
        (["--object", "box", "--seeds", "0"], "--seeds must be at least 1"),
        (["--object", "box", "--foam", "wet"], "no foam 'wet'"),
    ],
)
def test_a_fault_of_the_arguments_is_one_line(given: list[str], said: str, tmp_path: Path) -> None:
    command = ["expect", *given, "--out", str(tmp_path)]
    assert said in refused(*command, main=cli.main)
