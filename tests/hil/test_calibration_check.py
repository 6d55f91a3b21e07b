"""Whether the touches of a session agree with its full scale and mount."""

import contextlib
from dataclasses import replace
from pathlib import Path

import pytest

from taxeld.config.file import load
from taxeld.config.tables import SceneConfig
from taxeld.errors import SetupError
from taxeld_hil.calibration import check
from taxeld_hil.cli import main

SEEDS = 4
RECORDED = Path(__file__).parents[1] / "daemon" / "session"


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Sessions of a box that is touched by soft skins."""
    place = tmp_path_factory.mktemp("check")
    for seed in range(SEEDS):
        where = ["--out", str(place / str(seed)), "--seed", str(seed)]
        assert main(["run", "demo", "--clock", "fake", "--foam", "typical", *where]) == 0
    return [place / str(seed) for seed in range(SEEDS)]


@pytest.mark.check
def test_a_right_skin_is_not_doubted(sessions: list[Path]) -> None:
    for session in sessions:
        found = check.of_session(session, load(session / "config.toml"))
        assert not found.is_wrong, found
        assert list(found.lines())[-1] == "both hold"


@pytest.mark.check
def test_most_skins_of_a_wrong_full_scale_are_named(sessions: list[Path]) -> None:
    wrong = 0
    for session in sessions:
        text = (session / "config.toml").read_text(encoding="utf-8")
        other = session / "other.toml"
        other.write_text(text.replace("counts = 20000.0", "counts = 50000.0"), encoding="utf-8")
        with contextlib.suppress(SetupError):  # it may leave no pose to judge by
            wrong += check.of_session(session, load(other)).is_wrong
    assert wrong > SEEDS / 2


def test_few_touches_and_no_object_are_refused_with_what_is_needed() -> None:
    config = load(RECORDED / "config.toml")
    with pytest.raises(SetupError, match="the check needs 5 and p 30%"):
        check.of_session(RECORDED, config)
    with pytest.raises(SetupError, match=r"scene\.bundle: is empty"):
        check.of_session(RECORDED, replace(config, scene=SceneConfig()))
