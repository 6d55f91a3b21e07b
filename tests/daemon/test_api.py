"""The public face: every name, and the page and the notebook that show how it is used."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld import api

from .. import pages

ROOT = Path(__file__).parents[2]
PAGE, NOTEBOOK = ROOT / "docs" / "api.md", ROOT / "examples" / "belief.ipynb"
SESSION = Path(__file__).parent / "session"  # four contacts of a mug


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory with a session, as the page asks for."""
    shutil.copytree(SESSION, tmp_path / "session")
    return tmp_path


@pytest.mark.parametrize("name", api.__all__)
def test_every_public_name_is_there_and_says_what_it_is(name: str) -> None:
    found = getattr(api, name)
    assert found.__doc__
    assert not found.__doc__.startswith(f"{name}(")  # what a dataclass has without a docstring


def plain(text: str) -> str:
    """A text without its numbers and statuses, and the spaces by which arrays are aligned."""
    text = re.sub("|".join(api.Status.__members__), "STATUS", pages.NUMBER.sub("N", text))
    return re.sub(r"(?<=\[) +| +(?=[] ])", "", text)


@pytest.mark.parametrize(("page", "least"), [(PAGE, 4), (ROOT / "README.md", 1)])
def test_a_page_prints_what_it_shows(place: Path, page: Path, least: int) -> None:
    """Its blocks in their order; numbers may differ."""
    names: dict[str, Any] = {}
    shown = pages.blocks(page)
    assert len(shown) >= least
    with pages.working_in(place):
        for block in shown:
            said = pages.run(block.code, names)
            assert plain(said) == plain(block.shown), block.code


def test_the_estimator_on_recorded_activations_takes_ten_lines_and_gives_the_sessions_estimate(
    place: Path,
) -> None:
    """The same as the session's own pipeline, bit for bit."""
    _, estimator, *_ = pages.blocks(PAGE)
    assert len(estimator.code.splitlines()) <= 10
    names: dict[str, Any] = {"Replay": api.Replay}
    with pages.working_in(place):
        pages.run(estimator.code, names)
    for ours, replayed in (
        (names["estimate"].map, names["used"][-1].estimate.map),
        (names["estimate"].cov, names["used"][-1].estimate.cov),
    ):
        assert np.array_equal(ours, replayed)


def test_a_sessions_belief_is_that_of_its_last_scan(place: Path) -> None:
    session = api.Replay(place / "session")
    for outcome in session:
        poses, weights = session.belief
        estimate = outcome.estimate
        assert len(poses) == len(weights) == estimate.particles
    assert weights.sum() == pytest.approx(1.0)
    assert session.is_valid(estimate)
    assert session.why(estimate) is api.Why.VALID
    poses[:] = 0.0
    assert session.belief[0].any(), "what is handed out is a copy"


def test_a_seed_takes_the_place_of_the_sessions_own(place: Path) -> None:
    def last(seed: int | None) -> Any:
        *_, outcome = api.Replay(place / "session", seed=seed)
        return outcome.estimate.map.tolist()

    assert last(None) == last(5) != last(6)


def test_the_notebook_goes_from_a_session_to_a_picture_of_the_belief(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    names: dict[str, Any] = {}
    monkeypatch.setattr(plt, "show", lambda: None)
    with pages.working_in(place):
        for cell in pages.cells(NOTEBOOK):
            pages.run(cell, names)
    drawn = names["figure"].axes
    assert len(drawn) == 4, "one for each contact"
    for axes in drawn:
        assert any(len(c.get_offsets()) > 1 for c in axes.collections), "particles"
        assert len(axes.lines) > 1, "the object and the skin"
    plt.close("all")
