"""Pages say what their JSON says."""

import pytest

from tests import figures


def test_a_figure_that_differs_from_its_json_is_found() -> None:
    name = "works-misleading"
    page = f"<!-- figures: {name} -->\nNone misleads.\n<!-- end of figures -->\n"
    told = figures.filled(page)
    assert told != page
    assert figures.FIGURES[name]() in told
    assert figures.filled(told) == told


def test_some_is_never_shown_as_all_or_none() -> None:
    assert [figures.share(n, 400) for n in (0, 1, 399, 400)] == ["0 %", "1 %", "99 %", "100 %"]


def test_every_page_agrees_with_its_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert figures.main([]) == 0, capsys.readouterr().out
