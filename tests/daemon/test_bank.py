"""Which of several known objects is felt, or none; messages name each, and sessions replay."""

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from taxeld.commands.replay import Replay
from taxeld.commands.status import estimate_rows
from taxeld.config.tables import FilterConfig, SceneConfig
from taxeld.errors import SetupError
from taxeld.estimator.bank import FOLLOWED, Known
from taxeld.estimator.estimate import SURE, Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.model.scene import CONTINUOUS
from taxeld.pipeline.freshness import Why
from taxeld.proposals import bundle, choice
from taxeld.proposals.analytic import Table
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.sampler import Sampler
from taxeld.service.notices import Notices
from taxeld.stream import messages
from tests.rig.configurations import configuration
from tests.rig.pressed_box import World
from tests.rig.recorded import write_session
from tests.rig.scenes import Distance, box, disc, scene_of
from tests.rig.skins import SKIN

SIDES = (0.2, 1.3, 2.9, 4.5, 3.6, 5.2)
SHAPES = [(box(0.03, 0.05), 2), (disc(0.04), CONTINUOUS), (box(0.06, 0.06), 4)]
UNKNOWN = box(0.02, 0.1), 2


def model_of(shape: Distance, symmetry: int, skin: Layout) -> ObservationModel:
    return ObservationModel(scene_of(shape, skin, symmetry=symmetry), skin, 0.005)


@pytest.fixture(scope="module")
def known(skin: Layout) -> list[Known]:
    models = [model_of(*shape, skin) for shape in SHAPES]
    return [Known(model, Table(model, 4000)) for model in models]


def several(known: list[Known]) -> Estimator:
    first, *more = known
    return Estimator(first.model, first.proposal, FilterConfig(), more=more)


def press(subject: Estimator, world: World, sides: tuple[float, ...] = SIDES) -> list[Estimate]:
    return [world.press(subject, side) for side in sides]


@pytest.mark.parametrize("touched", range(len(SHAPES)))
def test_the_touched_object_is_named_and_found(known: list[Known], touched: int) -> None:
    """Before a touch all are alike. Their probabilities and that of none are one in all."""
    subject, world = several(known), World(known[touched].model)
    before = subject.estimate
    assert np.ptp(before.objects) == pytest.approx(0.0)
    assert before.status is Status.SEARCHING
    for estimate in [before, *press(subject, world)]:
        stands, moved, other = estimate.hypotheses
        assert sum(estimate.objects) == pytest.approx(stands + moved)
        assert sum(estimate.objects) + other == pytest.approx(1.0)
        assert min(estimate.objects) >= 0.0
        assert estimate.modes[0].object == estimate.object
        assert np.allclose(estimate.map, estimate.modes[0].pose)
        assert sum(mode.weight for mode in estimate.modes) <= 1.0 + 1e-9
    found = subject.estimate
    assert found.object == touched
    assert found.objects[touched] > SURE
    assert found.status is Status.CONVERGED
    assert subject.belief.metric.distance(found.map, world.truth) < 0.005


def test_an_object_that_is_none_of_them_is_said_to_be_other(
    known: list[Known], skin: Layout
) -> None:
    told = press(several(known), World(model_of(*UNKNOWN, skin)))
    assert told[-1].hypotheses.other > 0.9
    assert told[-1].status is Status.INCONSISTENT
    assert all(estimate.p < SURE for estimate in told)


def test_an_object_in_the_place_of_another_is_named(
    known: list[Known], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was ruled out before, when it cost nothing, and comes back with what is remembered."""
    subject, world = several(known), World(known[0].model)
    press(subject, world)
    assert subject.bank.ruled_out == {1, 2}
    asked: list[int] = []
    with monkeypatch.context() as patched:
        for k, belief in enumerate(subject.bank.beliefs):
            for name in ("take", "search", "adopt"):
                patched.setattr(belief, name, _counted(getattr(belief, name), asked, k))
        press(subject, world)
    assert set(asked) == {0}
    after = World(known[2].model)
    after.t = world.t + 1.0
    press(subject, after)
    assert subject.estimate.object == 2
    assert subject.estimate.objects[2] > 0.95
    assert subject.belief.metric.distance(subject.estimate.map, world.truth) < 0.005


def test_a_touch_is_learned_by_a_few_objects_at_once(known: list[Known]) -> None:
    """The others learn of it while there is nothing else to do, and nobody is sure before. Until
    then it is no evidence before itself, or it would count twice."""
    subject, world = several(known), World(known[2].model)
    press(subject, world, SIDES[:1])
    before, beliefs = subject.estimate, subject.bank.beliefs
    evidence = [belief.log_z for belief in beliefs]
    on_scan = subject.on_scan
    subject.on_scan = partial(on_scan, thinks=False)  # type: ignore[method-assign]
    world.press(subject, SIDES[1])
    assert subject.bank.is_behind
    (left,) = [k for k, belief in enumerate(beliefs) if belief.pending]
    assert len(known) - FOLLOWED == 1
    now = subject.estimate
    assert now.objects[left] / max(now.objects) == pytest.approx(
        before.objects[left] / max(before.objects), rel=0.7
    )
    assert beliefs[left].log_z == pytest.approx(evidence[left], abs=1.0)
    changed = False
    while subject.bank.is_behind:
        assert subject.has_thought
        assert not changed
        changed = subject.think()
    assert changed
    assert not beliefs[left].pending


def _counted(method, asked: list[int], k: int):  # type: ignore[no-untyped-def]
    def counted(*given):  # type: ignore[no-untyped-def]
        asked.append(k)
        return method(*given)

    return counted


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
