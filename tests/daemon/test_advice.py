"""Where to touch next: no approach begins near where the object may be, or beyond the link's reach,
and what is advised tells more than other touches."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.advice import hypotheses, lines
from taxeld.advice.advice import MOST, Advice, Advisor, Approach
from taxeld.advice.lines import FELT_M, Reach
from taxeld.advice.outcomes import Outcomes
from taxeld.arrays import Bools, Floats, Poses
from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.estimator import particles as pf
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.likelihood import NumpyExplainer
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel
from taxeld.proposals.analytic import Table
from tests.rig.examples import examples
from tests.rig.memories import memory_of, plus
from tests.rig.pressed_box import TRUTH, World, approach, estimator, settled
from tests.rig.scenes import DEPTH_MAX_M, box, disc, scene_of

FREE = Reach()


def asked(subject: Estimator, reach: Reach = FREE) -> Advice:
    return Advisor(subject, reach).advise()


def drawn(subject: Estimator, seed: int = 0) -> hypotheses.Guesses:
    return hypotheses.drawn(subject, np.random.default_rng(seed))


def touched(model: ObservationModel, angles: Sequence[float]) -> Estimator:
    world = World(model)
    subject = world.knowing()
    for angle in angles:
        world.press(subject, angle)
    return subject


def off_m(subject: Estimator) -> float:
    return float(subject.rule.metric.distance(subject.estimate.map, TRUTH))


def follow(world: World, subject: Estimator, told: Approach) -> None:
    """Come along an advised line, feel, press as deep as advised, and go back."""
    length_m = float(np.hypot(*(told.until - told.before)[:2]))
    direction, ahead = np.array([told.direction]), np.array([length_m])
    line = lines.Lines(told.link, told.before[None], direction, ahead)
    way = float(lines.travel(line, world.model, TRUTH[None])[0, 0])
    far = np.arange(0.0, min(way, length_m), 0.01)
    press = np.full(3, way + told.depth_m) if np.isfinite(way) else np.empty(0)
    for at in line.after_each(np.concatenate([far, press, far[::-1][:3]])):
        world.feel(subject, se2.compose(se2.inverse(TRUTH), at))
    world.t += 1.0
    world.feel(subject, se2.compose(se2.inverse(TRUTH), line.start[0]))


def gap_m(model: ObservationModel, sensor: Poses, poses: Poses) -> Floats:
    """(N,) gaps [m] between a link at `sensor` (3,) and objects at `poses` (N, 3)."""
    seen = se2.compose(se2.inverse(sensor), poses)
    return contacts.clearance(model.scene, model.layout.radius_m, seen)


BODY_M, HANDLE_M = 0.04, 0.075  # radius of the body; how far the handle reaches from its middle


def handled(skin: Layout, *further: Layout) -> ObservationModel:
    """A body and a handle beside it, which is no part of its outline, as a mug's is not."""
    body, handle = disc(BODY_M), box(0.01, 0.012)
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = BODY_M * np.column_stack([np.cos(angle), np.sin(angle)])

    def of(layout: Layout) -> ObservationModel:
        scene = scene_of(
            lambda x, y: np.minimum(body(x, y), handle(x - HANDLE_M + 0.01, y)), layout, symmetry=1
        )
        return ObservationModel(replace(scene, outline=ring), layout, DEPTH_MAX_M)

    first, *links = map(of, (skin, *further))
    return ObservationModel(first.scene, skin, DEPTH_MAX_M, links)


@pytest.fixture(scope="module")
def handled_model(skin: Layout) -> ObservationModel:
    return handled(skin)


@examples(25)
@given(
    touches=st.integers(0, 3),
    middle=st.tuples(*[st.floats(-0.3, 0.3)] * 2),
    half_m=st.floats(0.05, 0.4),
    clearance_m=st.floats(0.001, 0.05),
    yaw=st.floats(-180.0, 180.0),
    turn=st.floats(0.0, 90.0),
)
def test_no_approach_begins_near_a_hypothesis_or_leaves_what_the_link_reaches(
    touches: int,
    middle: tuple[float, float],
    half_m: float,
    clearance_m: float,
    yaw: float,
    turn: float,
) -> None:
    model = MODELS["box"]
    subject = touched(model, (0.2, 1.4, 2.9)[:touches])
    x, y = middle
    config = Reach(
        box_m=(x - half_m, x + half_m, y - half_m, y + half_m),
        yaw_deg=(yaw, yaw + turn),
        clearance_m=clearance_m,
    )
    found = asked(subject, config)
    may_be = np.array([mode.pose for mode in subject.estimate.modes if mode.weight >= 0.05])
    for one in found.approaches:
        if len(may_be):
            assert gap_m(model, one.before, may_be).min() >= clearance_m - 1e-3  # the grid's cells
        for at in (one.before, one.at, one.until):
            assert x - half_m - 1e-9 <= at[0] <= x + half_m + 1e-9
            assert y - half_m - 1e-9 <= at[1] <= y + half_m + 1e-9
            off = np.degrees(se2.wrap(at[2] - np.radians(yaw + 0.5 * turn)))
            assert abs(off) <= 0.5 * turn + 1e-6
        ahead = one.until[:2] - one.before[:2]
        assert np.hypot(*ahead) > 0.0
        assert abs(se2.wrap(np.arctan2(ahead[1], ahead[0]) - one.direction)) < 1e-6
        assert 0.0 < one.p_touch <= 1.0 + 1e-9
        assert 0.0 <= one.p_sure <= 1.0 + 1e-9


def test_a_link_goes_on_until_its_press_is_felt_and_no_farther(
    handled_model: ObservationModel,
) -> None:
    subject, rng = touched(handled_model, (0.3, 2.0)), np.random.default_rng(3)
    advisor, found = Advisor(subject, FREE), drawn(subject)
    fan = advisor.fan(found, 0)
    way = lines.travel(fan, handled_model, found.pose)
    for c in rng.choice(len(fan), 40, replace=False).tolist():
        for k in rng.choice(len(found.pose), 3, replace=False).tolist():
            travel_m = np.arange(0.0, fan.length_m[c], 5e-4)
            along = fan.only(slice(c, c + 1)).after_each(travel_m)
            seen = se2.compose(se2.inverse(along), found.pose[k])
            radius_m = handled_model.layout.radius_m
            gap = contacts.clearance(handled_model.scene, radius_m, seen)
            if np.isinf(way[c, k]):
                assert gap.min() > -FELT_M - 1e-3
            else:
                assert travel_m[np.argmax(gap < -FELT_M + 1e-3)] <= way[c, k] + 1e-3
                assert gap[travel_m < way[c, k] - 1e-3].min(initial=1.0) > -FELT_M - 1e-3


def test_following_the_advice_finds_a_handle_that_the_first_touch_did_not_meet(
    handled_model: ObservationModel,
) -> None:
    world = World(handled_model)
    subject = Estimator(handled_model, Table(handled_model, size=3000), FilterConfig())
    world.press(subject, 3.1)
    for _ in range(12):
        follow(world, subject, asked(subject).approaches[0])
        if off_m(subject) < 0.005:
            break
    assert off_m(subject) < 0.005


def test_what_no_touch_can_tell_is_no_reason_for_another_one(
    box_model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sure belief, spread a little: a touch would save more than a millimetre, and less than what
    stays unmodelled."""
    _, subject = settled(box_model)
    rule = subject.rule
    off = np.random.default_rng(0).standard_normal(rule.belief.pose.shape)
    rule.belief.pose = TRUTH + off * (0.0011, 0.0011, 0.01)
    assert asked(subject).is_enough
    assert not asked(touched(box_model, (0.2,))).is_enough
    monkeypatch.setattr("taxeld.advice.advice.UNMODELLED_M", 5e-4)
    assert not asked(subject).is_enough


def test_an_advice_keeps_to_what_the_robot_can_do(box_model: ObservationModel) -> None:
    untouched, subject = asked(estimator(box_model)), touched(box_model, (0.2, 1.5))
    assert (untouched.contacts, len(untouched.approaches)) == (0, MOST)
    nothing = asked(subject, Reach(box_m=(5.0, 6.0, 5.0, 6.0)))
    assert (nothing.approaches, nothing.is_enough, untouched.is_enough) == ((), False, False)
    found = asked(subject, Reach(directions_deg=(30.0, 210.0), depth_m=0.05)).approaches
    assert {round(float(np.degrees(one.direction))) for one in found} <= {30, 210}
    assert {one.depth_m for one in found} == {DEPTH_MAX_M}, "no deeper than the skin can tell"


def test_hypotheses_hold_every_mode_and_a_place_that_the_belief_has_lost(
    box_model: ObservationModel,
) -> None:
    subject = touched(box_model, (0.2, 1.5))
    found, modes = drawn(subject), [mode.pose for mode in subject.estimate.modes]
    np.testing.assert_array_equal(found.pose[: found.modes], modes)
    assert found.weight.sum() == pytest.approx(1.0)
    assert found.weight[: found.modes].sum() == 0.0
    rule = subject.rule
    rule.belief.pose = rule.belief.pose + np.array([0.1, 0.0, 0.0])
    assert (rule.metric.distance(drawn(subject).pose, TRUTH) < 0.01).any()


def test_the_rule_of_the_paper_remembers_nothing_so_it_is_refused(
    box_model: ObservationModel,
) -> None:
    subject = estimator(box_model, injection="paper")
    with pytest.raises(SetupError, match=r"^advice: needs the memory of filter"):
        Advisor(subject, FREE)


def test_what_two_objects_would_be_told_apart_by_is_worth_a_touch(skin: Layout) -> None:
    """A box, and one that is shorter at one end: its end tells, its side does not."""
    models = [
        ObservationModel(scene_of(box(0.03, half), skin, symmetry=2), skin, DEPTH_MAX_M)
        for half in (0.06, 0.045)
    ]
    first, second = (Known(model, Table(model, size=3000)) for model in models)
    subject = Estimator(models[0], first.proposal, FilterConfig(), more=[second])
    approach(subject, models[0])
    found = drawn(subject)
    assert found.objects == [0, 1]
    apart = Outcomes(subject, found)
    assert apart.now_m > 0.0
    assert asked(subject).approaches[0].gain > 0.0


@pytest.mark.parametrize("is_compiled", [True, False])
def test_a_scan_that_may_come_is_as_likely_as_when_it_has_come(
    box_model: ObservationModel, is_compiled: bool
) -> None:
    rng = np.random.default_rng(0)
    memory = memory_of(box_model, Noise())
    if not is_compiled:
        numpy = NumpyExplainer(box_model, Noise())
        memory = replace(memory, skin=replace(memory.skin, explainers=[numpy]))
    made = contacts.synthesise(box_model.scene, 0.04, DEPTH_MAX_M, 60, rng)
    sensor = np.tile([0.2, -0.1, 0.4], (len(made.pose), 1))
    poses = se2.compose(sensor, made.pose)
    z = box_model.activation(made.pose)[:4]
    z[3] = 0.0  # one is silent
    like = Observation(sensor[0], np.zeros(z.shape[1]), np.ones(z.shape[1], np.bool_))
    told = memory.foreseen(like, z, sensor[:4], poses)
    for k, reading in enumerate(z):
        felt = plus(memory, replace(like, z=reading, sensor=sensor[k]))
        np.testing.assert_allclose(told[:, k], felt.explain_next(felt.scans[-1], poses), atol=1e-3)


MODELS: dict[str, ObservationModel] = {}


@pytest.fixture(scope="module", autouse=True)
def models(box_model: ObservationModel) -> None:
    """For hypothesis, whose tests take no fixtures with a long `repr`."""
    MODELS["box"] = box_model


TURNED = se2.compose(TRUTH, np.array([0.0, 0.0, np.pi]))  # the handle is on the other side


class NoSamples:
    """A proposal without samples: all that is learned is what a belief made by hand is left."""

    name = "table"

    def propose(self, z: np.ndarray, live: np.ndarray, n: int, rng: np.random.Generator) -> Poses:  # noqa: ARG002
        return np.empty((0, 3))


def torn(model: ObservationModel) -> Estimator:
    """A belief in TRUTH and TURNED alike, and in little beside them."""
    subject = Estimator(
        model, NoSamples(), FilterConfig(), beside=[NoSamples()] * (len(model.links) - 1)
    )
    rule, n = subject.rule, subject.config.particles
    off = np.random.default_rng(0).standard_normal((n, 3)) * (0.001, 0.001, 0.01)
    pose = off + np.where((np.arange(n) % 2 == 0)[:, None], TRUTH, TURNED)
    rule.belief = pf.equal(pose, rule.memory.explain(pose))
    return subject


@pytest.fixture
def _both(monkeypatch: pytest.MonkeyPatch) -> None:
    """What advice takes for possible: both, a little spread."""
    off = np.random.default_rng(1).standard_normal((20, 3)) * (0.001, 0.001, 0.01)
    pose = off + np.repeat([TRUTH, TURNED], 10, axis=0)
    made = hypotheses.Guesses(pose, np.zeros(20, np.intp), np.full(20, 0.05), 0)
    monkeypatch.setattr(hypotheses, "drawn", lambda *_: made)


def share_right(model: ObservationModel, approach: Approach) -> float:
    """The belief in TRUTH after an approach."""
    subject, world = torn(model), World(model)
    follow(world, subject, approach)
    rule = subject.rule
    return float(rule.belief.weight[rule.metric.distance(rule.belief.pose, TRUTH) < 0.01].sum())


@pytest.mark.usefixtures("_both")
def test_an_advised_touch_tells_apart_what_one_touch_can(skin: Layout) -> None:
    model = handled(skin)
    (best, *_) = asked(torn(model)).approaches
    assert best.p_sure > 0.95
    assert share_right(model, best) > 0.9


@pytest.mark.usefixtures("_both")
def test_a_link_whose_skin_faces_away_is_not_advised_though_it_would_come_first(
    skin: Layout,
) -> None:
    """Neither link may turn, and the handle is met from one side alone: by the back of the first
    link, which feels nothing there, and by the second one's skin."""

    def only(of: Bools) -> Layout:
        return replace(
            skin, uid=skin.uid[of], position_m=skin.position_m[of], normal=skin.normal[of]
        )

    right = skin.normal[:, 0] > 0.3
    ahead = (float(np.degrees(TRUTH[2])) + 180.0,)  # onto the handle, from outside
    config = Reach(directions_deg=ahead, yaw_deg=(0.0, 0.0))
    for layouts, feels in (((right, ~right), 1), ((~right, right), 0)):
        first, second = map(only, layouts)
        model = handled(first, second)
        best, *_ = asked(torn(model), config).approaches
        assert best.link == feels
        assert best.p_sure > 0.95
        alone = handled((first, second)[1 - feels])
        assert asked(torn(alone), config).approaches[0].p_sure < 0.5
