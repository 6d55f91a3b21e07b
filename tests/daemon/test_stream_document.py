"""What the documentation says of the streams and of the Python interface is so."""

import contextlib
import re
import shutil
from enum import IntEnum
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from taxeld import api
from taxeld.door.heard import as_pose
from taxeld.estimator.estimate import ProposalKind, Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics, values
from tests.rig.configurations import configuration, served
from tests.rig.processes import TAXELD
from tests.rig.recorded import LiveSkin, Said, said_of

from .. import pages
from ..rig.stream_page import Types, documented, leaves, section

COMMANDS = ("status", "info", "tare", "reset")
PERIOD_S = 0.02  # a brisk session


@pytest.fixture(scope="module")
def heard(tmp_path_factory: pytest.TempPathFactory) -> Said:
    """All that a daemon sends and answers while its skin is touched."""
    place = tmp_path_factory.mktemp("run")
    publish = {"publish": {**served(place)["publish"], "counts": True}}
    asks = dict.fromkeys(COMMANDS, topics.PARTICLES.decode())
    with LiveSkin(place, touches=4, period_s=PERIOD_S, rest=100) as skin:
        path = configuration(place, source=skin.source, **publish)
        done = lambda said: skin.has_ended and said["info"]  # noqa: E731
        return said_of(place, [*TAXELD, "run", str(path)], asks, done)[0]


@pytest.mark.parametrize("topic", [topic.decode() for topic in topics.TOPICS])
def test_each_message_has_the_documented_keys_and_types(heard: Said, topic: str) -> None:
    keys, example = documented(topic)
    sent: Types = {}
    for message in heard[topic]:
        sent |= leaves(message)
        assert message.keys() == example.keys(), "every key is always there"
    unseen = keys.keys() - sent.keys()
    assert sent == {key: kind for key, kind in keys.items() if key not in unseen}
    assert all(key.endswith(("_taxels[]", "_modules[]", ".bus.*")) for key in unseen), (
        "of a recording, and of a skin that is whole, they are empty"
    )
    assert leaves(example) == keys


def test_the_commands_answer_what_is_documented(heard: Said) -> None:
    part = section("control")
    for name in COMMANDS:
        (answer,) = heard[name]
        (row,) = (line for line in part.splitlines() if line.startswith(f"- `{name}`"))
        named = [text for text in row.partition(": ")[0].split("`")[2:] if text.isidentifier()]
        assert sorted(answer) == sorted(["ok", *named])
    assert heard["info"][0]["info"] == heard["/taxeld/info"][0]
    assert heard["status"][0]["estimate"].keys() == heard["/taxeld/estimate"][0].keys()
    assert heard["status"][0]["health"].keys() == heard["/taxeld/health"][0].keys()


def test_the_table_of_health_is_the_documented_one() -> None:
    rows = [line for line in section("/taxeld/health").splitlines() if line.startswith("- `")]
    assert rows == values.TABLE


@pytest.mark.parametrize("kind", [Status, ProposalKind, Why])
def test_every_name_of_a_number_is_documented(kind: type[IntEnum]) -> None:
    text = section("/taxeld/estimate")
    for member in kind:
        assert f"{int(member)} `{member.name.lower()}`" in text


def test_the_documented_sensor_pose_is_taken() -> None:
    keys, example = documented("/robot/sensor_pose")
    assert leaves(example) == keys
    pose = as_pose([topics.SENSOR_POSE, msgpack.packb(example), b"0.0"])
    assert pose == tuple(example[key] for key in ("t", "x", "y", "theta"))


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
    with contextlib.chdir(place):
        for block in shown:
            assert plain(pages.run(block.code, names)) == plain(block.shown), block.code


def test_the_estimator_on_recorded_activations_takes_ten_lines_and_gives_the_sessions_estimate(
    place: Path,
) -> None:
    """The same as the session's own pipeline, bit for bit."""
    _, estimator, *_ = pages.blocks(PAGE)
    assert len(estimator.code.splitlines()) <= 10
    names: dict[str, Any] = {"Replay": api.Replay}
    with contextlib.chdir(place):
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
    pytest.importorskip("matplotlib").use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415

    names: dict[str, Any] = {}
    monkeypatch.setattr(plt, "show", lambda: None)
    with contextlib.chdir(place):
        for cell in pages.cells(NOTEBOOK):
            pages.run(cell, names)
    drawn = names["figure"].axes
    assert len(drawn) == 4, "one for each contact"
    for axes in drawn:
        assert any(len(c.get_offsets()) > 1 for c in axes.collections), "particles"
        assert len(axes.lines) > 1, "the object and the skin"
    plt.close("all")
