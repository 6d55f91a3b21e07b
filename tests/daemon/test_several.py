"""Several objects may be felt: messages name each, and a session of them is replayed."""

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from taxeld.commands.replay import Replay
from taxeld.commands.status import estimate_rows
from taxeld.config.tables import FilterConfig, SceneConfig
from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.estimator.estimate import Estimate
from taxeld.estimator.estimator import Estimator
from taxeld.pipeline.freshness import Why
from taxeld.proposals import bundle, choice
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.sampler import Sampler
from taxeld.service.notices import Notices
from taxeld.stream import messages
from tests.rig.configurations import configuration
from tests.rig.recorded import write_session
from tests.rig.skins import SKIN

THREE = ("box", "mug", "drill")
NAMES = ("003_cracker_box", "025_mug", "035_power_drill")


@pytest.fixture(scope="module")
def three() -> list[Bundle]:
    return bundle.load_all(SceneConfig(bundles=THREE), [SKIN])


def test_objects_without_the_chosen_sampler_have_the_table(three: list[Bundle]) -> None:
    """Wherever they stand in the list."""
    for bundles in (three, three[::-1]):
        samples = choice.samples(bundles, FilterConfig(proposal="density-64"), lambda: 0)
        assert isinstance(samples.proposals[1], Sampler)
        assert samples.proposals[bundles.index(three[2])].name == "table"


def estimate_of(three: list[Bundle], *objects: float, number: int = 0) -> Estimate:
    first, *more = (Known(one.model, one.proposal("table")) for one in three)
    made = Estimator(first.model, first.proposal, FilterConfig(), more=more).estimate
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
    told = messages.info(SKIN, bundle.scenes(three), "")
    numbered = [(one["name"], one["symmetry"]) for one in told["objects"]]
    assert numbered == list(zip(NAMES, (2, 1, 1), strict=True))
    assert told["objects"][0].items() <= (told | {"name": told["object"]}).items()


def test_the_log_says_once_which_object_it_surely_is(
    three: list[Bundle], caplog: pytest.LogCaptureFixture
) -> None:
    told = Notices(SimpleNamespace(), NAMES)  # type: ignore[arg-type]
    with caplog.at_level(logging.INFO, logger="taxeld"):
        for now_s, p in enumerate((0.9, 0.995, 0.999)):
            told.estimate(estimate_of(three, 0.0, p, 0.0, number=1), Why.VALID, "", now_s)
    lines = [line for line in caplog.messages if line.startswith("object")]
    assert lines == ["object: 025_mug, p 99.5 %"]


def test_a_session_of_several_objects_is_replayed(tmp_path: Path) -> None:
    write_session(tmp_path, touches=2)
    path = configuration(tmp_path, scene={"bundles": THREE})
    replays = [Replay(tmp_path) for _ in range(2)]
    assert replays[0].names == NAMES
    first, again = ([outcome.estimate for outcome in one] for one in replays)
    assert [e.objects for e in first] == [e.objects for e in again]
    assert first[-1].contacts == 2
    assert len(first[-1].objects) == 3
    path.write_text(path.read_text(encoding="utf-8").replace("mug", "party"), encoding="utf-8")
    with pytest.raises(SetupError, match=r"scene\.bundles: no bundle 'party'.*a session does not"):
        Replay(tmp_path)
