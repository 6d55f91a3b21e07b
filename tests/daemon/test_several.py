"""Several objects may be felt: bundles that belong together, and messages that name each."""

import json
import logging
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from taxeld.commands.check import faults
from taxeld.commands.replay import Replay
from taxeld.commands.status import estimate_rows
from taxeld.config.file import load
from taxeld.config.tables import OBJECTS_MAX, FilterConfig, SceneConfig
from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.pipeline.freshness import Why
from taxeld.proposals import bundle, choice, several
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.sampler import Sampler
from taxeld.service.loop import Daemon
from taxeld.service.notices import Notices
from taxeld.stream import messages
from tests.rig.commands import refused
from tests.rig.configurations import config, configuration
from tests.rig.recorded import LiveSkin, golden, write_golden, write_session
from tests.rig.skins import SKIN

THREE = ("box", "mug", "drill")
NAMES = ("003_cracker_box", "025_mug", "035_power_drill")
NOW = FilterConfig()


@pytest.fixture(scope="module")
def three() -> list[Bundle]:
    return several.load(SceneConfig(bundles=THREE), [SKIN])


@pytest.fixture
def place(tmp_path: Path) -> Path:
    write_golden(tmp_path)
    return tmp_path


def changed(place: Path, name: str, **keys: object) -> Path:
    """A copy of the drill's bundle, with these keys in its description."""
    path = Path(shutil.copytree(bundle.find("drill"), place / name))
    about = json.loads((path / "bundle.json").read_text(encoding="utf-8"))
    (path / "bundle.json").write_text(json.dumps(about | keys), encoding="utf-8")
    return path


MANY = [f"object {k}" for k in range(OBJECTS_MAX + 1)]
TABLES: list[tuple[dict[str, dict[str, Any]], str]] = [
    (
        {"scene": {"bundle": "box", "bundles": ["mug"]}},
        "scene.bundles: is given beside scene.bundle; keep one of the two",
    ),
    ({"scene": {"bundles": ["box", "mug", "box"]}}, "scene.bundles: names 'box' more than once"),
    ({"scene": {"bundles": MANY}}, "scene.bundles: names 17 objects; 16 are told apart at most"),
    (
        {"scene": {"bundles": THREE}, "filter": {"injection": "paper"}},
        "filter.injection: 'paper' knows one object: name one scene.bundle",
    ),
    (
        {"scene": {"bundles": THREE}, "filter": {"motion": "push"}},
        "filter.motion: a pushed object must be known: name one scene.bundle",
    ),
    ({"scene": {"bundles": ["box", "party"]}}, "scene.bundles: no bundle 'party'; shipped are"),
    ({"scene": {"bundles": ["box", "same"]}}, "scene.bundles: box and "),
    ({"scene": {"bundles": ["drill", "again"]}}, "scene.bundles: "),
    ({"scene": {"bundles": ["box", "deep"]}}, "scene.bundles: box was built for a depth of 0.005"),
    ({"scene": {"bundles": ["box", "round"]}}, "scene.bundles: round is for the layout ball (0)"),
    ({"scene": {"bundles": ["box", "broken"]}}, ""),
]


@pytest.mark.parametrize(
    ("command", "tables", "line"),
    [*(("check", *given) for given in TABLES), ("run", *TABLES[0]), ("run", *TABLES[-1])],
)
def test_objects_that_cannot_be_told_apart_are_refused_in_one_line(
    place: Path, command: str, tables: dict[str, dict[str, Any]], line: str
) -> None:
    (place / "same").symlink_to(bundle.find("box"))
    changed(place, "again")
    changed(place, "deep", object="deep", depth_max_m=0.004)
    changed(place, "round", object="round", layout={"name": "ball", "digest": "0"})
    (changed(place, "broken", object="broken") / "scene.npz").write_bytes(b"no scene")
    scene = tables["scene"]
    said = refused(command, golden(place, **tables | {"scene": {"bundle": "", **scene}}))
    assert said.startswith(line)
    last = scene.get("bundles", [""])[-1]
    ends = {
        "same": "are one bundle; name it once",
        "again": "are both of 035_power_drill; keep one of the two",
        "deep": "deep for 0.004 m; build both for one",
        "broken": f"{place}/broken/scene.npz",
    }
    assert ends.get(last, "") in said


def test_an_object_of_the_name_other_is_named_with_its_directory(tmp_path: Path) -> None:
    path = changed(tmp_path, "thing", object="other")
    assert several.names(SceneConfig(bundles=("box", str(path)))) == (NAMES[0], "thing/other")


def test_bundles_are_found_beside_the_configuration(place: Path) -> None:
    changed(place, "own", object="own")
    path = golden(place, scene={"bundles": ["box", "own/"]})
    assert load(path).scene.names == ("box", str(place / "own"))
    assert faults(load(path)) == []


def test_objects_without_the_chosen_sampler_have_the_table(three: list[Bundle]) -> None:
    """Wherever they stand in the list."""
    for bundles in (three, three[::-1]):
        fixed = config(scene={"bundles": THREE}, filter={"proposal": "density-64"})
        samples, drill = choice.samples(bundles, fixed, lambda: 0), bundles.index(three[2])
        assert isinstance(samples.proposals[1], Sampler)
        assert samples.proposals[drill].name == "table"


def estimate_of(three: list[Bundle], *objects: float, number: int = 0) -> Estimate:
    first, *more = (Known(one.model, one.proposal("table")) for one in three)
    made = Estimator(first.model, first.proposal, NOW, more=more).estimate
    return replace(made, object=number, objects=objects)


def test_an_estimate_names_each_object_and_none_of_them(three: list[Bundle]) -> None:
    found = estimate_of(three, 0.2, 0.7, 0.05, number=1)
    message = messages.estimate(found, names=NAMES, seq=0, why=Why.VALID)
    assert message["object"] == 1
    assert message["objects"] == pytest.approx(
        dict(zip((*NAMES, "other"), (0.2, 0.7, 0.05, 0.05), strict=True))
    )
    assert {mode["object"] for mode in message["modes"]} <= {0, 1, 2}
    assert messages.object_of(message) == "025_mug 70.0%"
    assert dict(estimate_rows(message))["Object"] == "025_mug 70.0%"


def test_info_describes_each_object_by_its_number(three: list[Bundle]) -> None:
    told = messages.info(SKIN, several.scenes(three), "")
    assert [one["name"] for one in told["objects"]] == list(NAMES)
    assert [one["symmetry"] for one in told["objects"]] == [2, 1, 1]
    first = {"name": told["object"], "symmetry": told["symmetry"], "outline": told["outline"]}
    assert told["objects"][0] == first


def test_the_log_says_once_which_object_it_surely_is(
    three: list[Bundle], caplog: pytest.LogCaptureFixture
) -> None:
    told = Notices(NAMES, "table", [])
    with caplog.at_level(logging.INFO, logger="taxeld"):
        for now_s, p in enumerate((0.9, 0.995, 0.999)):
            told.estimate(estimate_of(three, 0.0, p, 0.0, number=1), Why.VALID, "", now_s)
    lines = [line for line in caplog.messages if line.startswith("object")]
    assert lines == ["object: 025_mug, p 99.5 %"]


@pytest.fixture
def session(tmp_path: Path) -> Path:
    write_session(tmp_path, touches=2)
    configuration(tmp_path, scene={"bundles": THREE})
    return tmp_path


def test_a_session_of_several_objects_is_replayed(session: Path) -> None:
    replays = [Replay(session) for _ in range(2)]
    assert replays[0].names == NAMES
    first, again = ([outcome.estimate for outcome in one] for one in replays)
    assert [e.objects for e in first] == [e.objects for e in again]
    assert first[-1].contacts == 2
    assert len(first[-1].objects) == 3


@pytest.mark.check
def test_a_daemon_publishes_several_objects(tmp_path: Path) -> None:
    with LiveSkin(tmp_path) as skin:
        path = configuration(tmp_path, source=skin.source, scene={"bundles": THREE})
        with closing(Daemon(load(path))) as daemon:
            daemon.run(lambda: daemon.stop() if daemon.pipeline.estimate.contacts else None)
            estimate = daemon.publisher.state()["estimate"]
    assert list(estimate["objects"]) == [*NAMES, "other"]
    assert sum(estimate["objects"].values()) == pytest.approx(1.0)


def test_a_bundle_that_is_not_found_is_said_of_a_session_as_well(session: Path) -> None:
    path = session / "config.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("mug", "party"), encoding="utf-8")
    with pytest.raises(SetupError, match=r"scene\.bundles: no bundle 'party'.*a session does not"):
        Replay(session)
