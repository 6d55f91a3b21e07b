"""`taxeld advise`: a client that learns what a daemon has felt, and advises by it."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.commands import advise
from taxeld.config.file import load
from taxeld.estimator.scans import Arrays
from taxeld.model import se2
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals.bundle import Bundle
from taxeld.stream import client
from tests.rig.commands import printed, refused
from tests.rig.memories import remembered

from .test_loop import settings
from .test_pipeline import CAN, CONFIG, ROBOT, TRUTH, pipeline_of, story, taken

Answer = Callable[[dict[str, Any] | None], None]


@pytest.fixture
def felt(box: Bundle) -> Pipeline:
    """What a daemon has felt of the box in one touch."""
    pipeline = pipeline_of(box, ROBOT)
    taken(pipeline, story(box, 5.0))
    return pipeline


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Answer:
    """Sets what the daemon answers."""
    return lambda given: monkeypatch.setattr(client, "ask", lambda *_: given)


def answered(memory: Arrays) -> dict[str, Any]:
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **memory)
    return {"ok": True, "memory": packed.getvalue()}


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """The daemon's configuration."""
    path = tmp_path / "can0.toml"
    path.write_text(f"[source]\n{CAN}\n{CONFIG}{ROBOT}", encoding="utf-8")
    return path


def test_it_advises_by_what_the_daemon_has_felt(
    felt: Pipeline, answer: Answer, config: Path
) -> None:
    answer(answered(remembered(felt.estimator)))
    said = printed("advise", config).splitlines()
    assert said[0] == "after 1 contacts, best first:"
    assert said[1].startswith("1. from x ")
    as_json = printed("advise", "--json", config)
    assert as_json == printed("advise", "--json", config)
    told = json.loads(as_json)
    assert (told["contacts"], told["enough"]) == (1, False)
    best = told["approaches"][0]
    away_m = np.hypot(best["at"]["x"] - TRUTH[0], best["at"]["y"] - TRUTH[1])
    assert 0.02 < away_m < 0.3
    assert 0.0 < best["p_touch"] <= 1.0


def test_approaches_are_told_in_the_poses_that_the_robot_sends(
    felt: Pipeline, config: Path
) -> None:
    adviser, mount = advise.Adviser(load(config)), np.array([0.003, -0.002, 0.1])
    own = adviser.advise(remembered(felt.estimator)).approaches[0]
    adviser._mounts = [mount]
    robot = adviser.advise(remembered(felt.estimator)).approaches[0]
    assert se2.compose(robot.at, mount) == pytest.approx(own.at)


def test_where_there_is_no_advice_it_says_why(
    felt: Pipeline, answer: Answer, config: Path, tmp_path: Path
) -> None:
    answer(None)
    assert "no daemon answers" in refused("advise", config, status=1)
    answer({"ok": False, "error": "nothing was felt yet: touch the object first"})
    assert "nothing was felt yet" in refused("advise", config, status=1)
    answer(answered(remembered(felt.estimator) | {"digest": np.array("other")}))
    assert "the daemon has another scene" in refused("advise", config)
    assert refused("advise", config, "--reach", 1, 0, 0, 1).startswith("reach: (1.0, 0.0, ")
    bare = tmp_path / "bare.toml"
    text = settings(tmp_path)
    bare.write_text(text.replace('bundle = "box"', 'bundle = ""'), encoding="utf-8")
    assert refused("advise", bare).startswith("scene.bundle: is empty")


def test_following_tells_again_only_once_more_was_felt(
    felt: Pipeline, answer: Answer, config: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(advise, "LOOK_S", 0.0)
    memory, looks = remembered(felt.estimator), iter(range(6))
    answer(answered(memory))

    def stopping() -> bool:
        look = next(looks)
        if look == 3:
            answer(answered(memory | {"number": memory["number"] + 1}))
        return look == 5

    assert len(list(advise.follow(load(config), None, stopping))) == 2
