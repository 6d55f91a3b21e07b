"""Where to touch next: what a touch would tell is what it then tells, of every approach."""

import contextlib
import io
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.advice import advice
from taxeld.advice.advice import Advised, TouchMemory, advise
from taxeld.advice.candidates import FELT_M, LEAST_STEP_M, Candidate, way_until_felt
from taxeld.arrays import Bools
from taxeld.commands.advise import read
from taxeld.config.tables import FilterConfig
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.model.symmetry import Mode
from taxeld.proposals.analytic import Projection, Table
from taxeld.proposals.bundle import Bundle
from taxeld.stream import client
from taxeld_sim.world.plan import Circle
from tests.rig.commands import printed, refused, refuses
from tests.rig.memories import memory_of, plus, remembered
from tests.rig.pressed_box import TRUTH, World, approach, estimator, settled
from tests.rig.scenes import DEPTH_MAX_M, box, disc, scene_of

from .. import pages
from .test_pipeline import CAN, CONFIG, ROBOT, pipeline_of, story, taken


def ring(model: ObservationModel) -> list[Candidate]:
    return Circle(model, TRUTH, model.scene.reach).ring(0)


def advised(subject: Estimator) -> list[Advised]:
    return advise(TouchMemory(subject), ring(subject.model))


def unsure(model: ObservationModel, *angles: float) -> Estimator:
    """What is pressed from some sides, by one that knows no more of the object."""
    subject, world = Estimator(model, Table(model, size=3000), FilterConfig()), World(model)
    for angle in angles:
        world.press(subject, angle)
    return subject


def handled(*layouts: Layout) -> ObservationModel:
    """A body and a handle on one side of it, which is no part of its outline, as a mug's is not."""
    body, handle = disc(0.04), box(0.01, 0.012)
    links = [
        ObservationModel(
            scene_of(lambda x, y: np.minimum(body(x, y), handle(x - 0.065, y)), each, symmetry=1),
            each,
            DEPTH_MAX_M,
        )
        for each in layouts
    ]
    return ObservationModel(links[0].scene, layouts[0], DEPTH_MAX_M, links[1:])


def test_a_link_goes_on_until_its_press_is_felt_and_no_farther(skin: Layout) -> None:
    model = handled(skin)
    poses = TRUTH + np.random.default_rng(3).normal(0.0, [0.02, 0.02, 1.0], (4, 3))
    for each in ring(model):
        travel_m = np.arange(0.0, each.length_m, 5e-4)
        for pose, way in zip(poses, way_until_felt(each, model, poses), strict=True):
            seen = se2.compose(se2.inverse(each.after(travel_m)), pose)
            gap = contacts.clearance(model.scene, model.layout.radius_m, seen)
            assert gap[travel_m < way - 1e-3].min(initial=1.0) > -FELT_M
            if np.isfinite(way):
                assert gap[travel_m <= way + 1e-3][-1] < -FELT_M + 5e-4


@pytest.mark.parametrize("angles", [(), (0.2,), (0.2, 1.4, 2.9)])
def test_every_candidate_is_ranked_and_none_touches_the_belief_before_it_is_said_to(
    box_model: ObservationModel, angles: Sequence[float]
) -> None:
    subject = unsure(box_model, *angles)
    found, poses = advised(subject), np.array([each.pose for each in advice.places(subject)])
    assert {each.candidate for each in found} == set(ring(box_model))
    assert [each.nats for each in found] == sorted((each.nats for each in found), reverse=True)
    for each in found:
        assert -0.1 < each.nats <= np.log(len(poses))
        free = each.candidate.after(each.free_m * np.linspace(0.0, 0.99, 20))
        seen = se2.compose(se2.inverse(free[:, None]), poses).reshape(-1, 3)
        gap_m = contacts.clearance(box_model.scene, 0.04, seen).min()
        assert (gap_m > -FELT_M - LEAST_STEP_M) if each.free_m else (gap_m <= -FELT_M)


def test_a_touch_of_what_is_known_for_sure_tells_nothing(box_model: ObservationModel) -> None:
    _, sure = settled(box_model)
    assert advised(sure)[0].nats < 0.1 < advised(unsure(box_model, 0.2))[0].nats


def test_candidates_are_of_the_poses_that_the_robot_sends(box_model: ObservationModel) -> None:
    subject, mount = unsure(box_model, 0.2), np.array([0.003, -0.002, 0.1])
    sent, way_m = Candidate(0.4, 0.05, 3.0, -0.2, 0.05), np.array([0.0, 0.3])
    [told] = advise(TouchMemory(subject, [mount]), [sent])
    assert advise(TouchMemory(subject), [sent.of(mount)]) == [
        replace(told, candidate=sent.of(mount))
    ]
    np.testing.assert_allclose(sent.of(mount).after(way_m), se2.compose(sent.after(way_m), mount))


def test_a_rule_that_remembers_nothing_is_refused(box_model: ObservationModel) -> None:
    refuses(
        r"^advice: needs the memory of filter", advised, estimator(box_model, injection="paper")
    )


def test_what_two_objects_would_be_told_apart_by_is_worth_a_touch(skin: Layout) -> None:
    """A box, and one that is shorter at one end: its end tells, its side does not."""
    models = [
        ObservationModel(scene_of(box(0.03, half), skin, symmetry=2), skin, DEPTH_MAX_M)
        for half in (0.06, 0.045)
    ]
    first, second = (Known(model, Table(model, size=3000)) for model in models)
    subject = Estimator(models[0], first.proposal, FilterConfig(), more=[second])
    approach(subject, models[0])
    assert {each.object for each in advice.places(subject)} == {0, 1}
    best, *_, worst = advised(subject)
    assert best.nats > worst.nats + 0.3


def test_a_scan_that_may_come_is_as_likely_as_when_it_has_come(box_model: ObservationModel) -> None:
    rng, memory = np.random.default_rng(0), memory_of(box_model, Noise())
    made = contacts.synthesise(box_model.scene, 0.04, DEPTH_MAX_M, 60, rng)
    sensor = np.tile([0.2, -0.1, 0.4], (len(made.pose), 1))
    poses = se2.compose(sensor, made.pose)
    z = box_model.activation(made.pose)[:4]
    z[3] = 0.0  # one is silent
    like = Observation(sensor[0], np.zeros(z.shape[1]), np.ones(z.shape[1], np.bool_))
    told = memory.foreseen(like, z, sensor[:4], poses)
    for k, reading in enumerate(z):
        felt = plus(memory, replace(like, z=reading, sensor=sensor[k]))
        np.testing.assert_allclose(told[:, k], felt.explain_newest(poses)[:, 0], atol=1e-3)


@pytest.fixture
def _torn(monkeypatch: pytest.MonkeyPatch) -> None:
    """A belief in two places: the handle is on the one side or on the other."""
    turned = se2.compose(TRUTH, np.array([0.0, 0.0, np.pi]))
    found = [Mode(each, 0.5, np.empty(0, np.intp)) for each in (TRUTH, turned)]
    monkeypatch.setattr(advice, "places", lambda _: found)


@pytest.mark.usefixtures("_torn")
def test_a_touch_tells_which_of_two_places_it_is_or_nothing(skin: Layout) -> None:
    best, *_, worst = advised(estimator(handled(skin)))
    assert best.nats == pytest.approx(np.log(2.0), abs=0.1)
    assert worst.nats == pytest.approx(0.0, abs=0.1)


@pytest.mark.usefixtures("_torn")
def test_a_skin_that_faces_away_tells_nothing_though_its_link_touches(skin: Layout) -> None:
    """The handle is met from one side alone: by the back of one link, and by the other's skin."""
    (x, y), (x1, y1) = se2.apply(TRUTH, np.array([[0.25, 0.0], [-0.25, 0.0]]))
    right = skin.normal[:, 0] > 0.3
    model = handled(*(only(skin, of) for of in (right, ~right)))
    subject = Estimator(model, Projection(model), FilterConfig(), beside=[Projection(model)])
    ways = [Candidate(x, y, TRUTH[2], x1, y1, link) for link in (0, 1)]
    best, worst = advise(TouchMemory(subject), ways)
    assert (best.candidate.link, worst.candidate.link, worst.p_touch) == (1, 0, 0.0)
    assert best.nats > 0.6
    assert worst.nats == pytest.approx(0.0, abs=0.1)


def only(skin: Layout, of: Bools) -> Layout:
    """Some of its taxels."""
    return replace(skin, uid=skin.uid[of], position_m=skin.position_m[of], normal=skin.normal[of])


HEAD = "x,y,theta,x1,y1"
PAGE = Path(__file__).parents[2] / "docs" / "advice.md"


@pytest.fixture
def answer(box: Bundle, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Of a daemon that has felt the box in one touch."""
    pipeline, packed = pipeline_of(box, ROBOT), io.BytesIO()
    taken(pipeline, story(box, 5.0))
    np.savez(packed, allow_pickle=False, **remembered(pipeline.estimator))
    given = {"ok": True, "memory": packed.getvalue()}
    monkeypatch.setattr(client, "ask", lambda *_: given)
    return given


@pytest.fixture
def asked(tmp_path: Path) -> tuple[str, Path, str, Path]:
    """With the daemon's configuration, and the page's candidates."""
    config = tmp_path / "can0.toml"
    config.write_text(f"[source]\n{CAN}\n{CONFIG}{ROBOT}", encoding="utf-8")
    with contextlib.chdir(tmp_path):
        pages.run(pages.blocks(PAGE)[0].code, {})
    return "advise", config, "--candidates", tmp_path / "ring.csv"


@pytest.mark.usefixtures("answer")
def test_candidates_are_ranked_by_what_the_daemon_has_felt_as_the_page_shows(asked: Any) -> None:
    said, as_json = printed(*asked), printed(*asked, "--json")
    assert as_json == printed(*asked, "--json")
    told = [json.loads(line) for line in as_json.splitlines()]
    assert [f"{each['nats']:.2f}" for each in told] == re.findall(r"^\d\S*", said, re.MULTILINE)
    assert told[0]["nats"] > told[-1]["nats"]
    shown = dict(pages.FENCED.findall(PAGE.read_text("utf-8")))["console"].partition("\n")[2]
    assert pages.NUMBER.sub("N", shown).split() == pages.NUMBER.sub("N", said).split(), said


def test_where_there_is_no_advice_it_says_why(answer: dict[str, Any], asked: Any) -> None:
    text = asked[1].read_text("utf-8")
    for was, other, says in (
        (CONFIG, "", "scene.bundle: is empty"),
        ('"manifold"', '"manifold"\nseed = 7', "the daemon has another scene"),
        ('"manifold"', '"manifold"\ninjection = "paper"', "the daemon has another scene"),
    ):
        asked[1].write_text(text.replace(was, other), encoding="utf-8")
        assert refused(*asked).startswith(says)
    answer |= {"ok": False, "error": "nothing was felt yet"}
    assert "nothing was felt yet" in refused(*asked, status=1)


def test_candidates_are_of_the_link_that_a_column_names(tmp_path: Path) -> None:
    table = tmp_path / "ways.csv"
    table.write_text(f"{HEAD},link\n0.1,0.2,-1,0.3,0.4,right\n", encoding="utf-8")
    assert read(table, ["left", "right"]) == [Candidate(0.1, 0.2, -1.0, 0.3, 0.4, 1)]


@pytest.mark.usefixtures("answer")
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", ": unreadable (no lines of UTF-8 text); name a CSV file of x,y,theta,x1,y1"),
        (b"\xff\xfe", ": unreadable (no lines of UTF-8 text); name a CSV file of x,y,theta,x1,y1"),
        (b"x,y\n1,2\n", ": must be the line x,y,theta,x1,y1 and one for each approach"),
        (HEAD.encode(), ": must be the line x,y,theta,x1,y1 and one for each approach"),
        (b"0,0,0,1,0\n0,0,0,1\n", ":3: must be x,y,theta,x1,y1, not '0,0,0,1'"),
        (b"0,0,0,1,0,left\n", ":2: must be x,y,theta,x1,y1, not '0,0,0,1,0,left'"),
        (b"0,a,0,1,0\n", ":2: must be x,y,theta,x1,y1, not '0,a,0,1,0'"),
        (b"0,nan,0,1,0\n", ":2: must be metres and radians, 10 at most"),
        (b"0,0,90,1,0\n", ":2: must be metres and radians, 10 at most"),
        (b"1,1,0,1,1\n", ":2: must end elsewhere than it begins"),
        (b"0,0,0,1,0\n" * 1001, "candidates: must be at most 1000, not 1001"),
    ],
)
def test_a_table_that_is_none_is_refused_in_a_line_with_its_place(
    asked: Any, text: bytes, says: str
) -> None:
    asked[3].write_bytes(text if text[:1] in b"x\xff" else f"{HEAD}\n".encode() + text)
    assert refused(*asked) == (f"{asked[3]}{says}\n" if says.startswith(":") else f"{says}\n")
