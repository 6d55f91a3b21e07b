"""Pictures of a session say what is drawn, in which units, and tell the story in its order."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib.figure import Figure
from matplotlib.image import imread

from taxeld.commands.replay import open_pipeline
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld_hil.run import picture
from taxeld_hil.run.picture import DrawnScan, four

SESSION = Path(__file__).parents[1] / "daemon" / "session"  # four contacts of a mug


def last_of(moments: list[DrawnScan]) -> dict[str, DrawnScan]:
    """Four moments of a session whose object is not found."""
    return dict(zip("abcd", moments[-4:], strict=True))


def test_moments_are_drawn_in_millimetres_with_a_colour_bar_and_a_legend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept, out, save = list[Figure](), tmp_path / "x.png", picture.save
    monkeypatch.setattr(
        picture, "save", lambda figure, out: (kept.append(figure), save(figure, out))
    )
    monkeypatch.setattr(picture, "four", last_of)
    picture.draw(SESSION, out)
    assert out.stat().st_size < 300_000, "small enough for a page"
    assert imread(out).shape[1] > 800
    (figure,) = kept
    *panels, bar = figure.axes
    above = panels[:4]
    assert {axis.get_xlabel() for axis in above} == {"x [mm]"}
    assert [axis.get_ylabel() for axis in above] == ["y [mm]", "", "", ""]
    assert all(10.0 < np.ptp(axis.get_xlim()) < 2000.0 for axis in above), "not metres"
    assert bar.get_ylabel() == "activation of a taxel [full scale]"
    named = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "object, estimated" in named
    assert "object, true" not in named, "nobody knows it of this session"


def test_the_four_moments_are_no_touch_the_first_the_last_doubt_and_the_object_found() -> None:
    base = open_pipeline(SESSION, config_file.load(SESSION / "config.toml")).estimate
    moments = [
        DrawnScan(
            replace(base, status=status, contacts=contacts, contact=contact),
            np.array([z]),
            np.zeros(3),
            np.zeros((0, 3)),
        )
        for status, contacts, contact, z in (
            (Status.SEARCHING, 0, False, 0.0),
            (Status.SEARCHING, 0, False, 0.1),  # the last before the touch
            (Status.AMBIGUOUS, 1, True, 0.2),
            (Status.AMBIGUOUS, 1, True, 0.9),  # the deepest of the first touch
            (Status.AMBIGUOUS, 1, False, 0.0),
            (Status.AMBIGUOUS, 2, True, 0.3),  # the next touch begins
            (Status.AMBIGUOUS, 2, True, 0.4),
            (Status.CONVERGED, 2, False, 0.0),
            (Status.CONVERGED, 3, True, 0.5),  # found, and touched
        )
    ]
    assert [one.z[0] for one in four(moments).values()] == [0.1, 0.9, 0.3, 0.5]
    assert four(moments[:7]) == {}, "not found"


def test_a_session_whose_object_is_not_found_is_one_line_with_or_without_a_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A truth that was cut before its first row is none."""
    shutil.copytree(SESSION, tmp_path / "s")
    (tmp_path / "s" / "truth.csv").write_text("t,x,y,theta\n", encoding="ascii")
    monkeypatch.setattr(picture, "_scans", lambda *_: iter(()))
    for session in (SESSION, tmp_path / "s"):
        with pytest.raises(SetupError, match="is not found by touch"):
            picture.draw(session, tmp_path / "x.png")
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize("name", ["no/x.png", "x.nothing"])
def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path, name: str) -> None:
    with pytest.raises(SetupError, match="--png: cannot write"):
        picture.save(Figure(), tmp_path / name)
