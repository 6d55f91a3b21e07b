"""Skins of several links that touch one object: one belief, whatever one of them does."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands import check, replay
from taxeld.commands.record import recorder_of
from taxeld.config.file import load, parse
from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.likelihood import NumpyExplainer
from taxeld.estimator.memory import Memory
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.model.observation import Activation, ObservationModel
from taxeld.pipeline.freshness import Why
from taxeld.proposals import bundle
from taxeld.proposals.analytic import Table
from taxeld.service.loop import Daemon
from taxeld.source.links import joint
from taxeld.source.recorder import Recorder
from taxeld.source.session import SensorPose
from tests.rig.clocks import until
from tests.rig.commands import refuses
from tests.rig.pressed_box import TRUTH, World, box_side
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.virtual_hub import VirtualHub

SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
SECOND = SPEC + ",sui=9"
SERVED = '[publish]\nendpoints = []\n[control]\nendpoint = ""\n'
HEAD = '[scene]\nbundle = "box"\n[filter]\nproposal = "manifold"\n'


def links(*tables: str) -> str:
    """A configuration of links with these keys each."""
    return HEAD + "".join(f"[[skin]]\n{table}\n" for table in tables)


def source(device: Path) -> str:
    return f'source = {{kind = "serial", channel = "{device}", period_ms = 10}}'


class TwoHubs:
    """A daemon, and the hubs of its links."""

    def __init__(self, daemon: Daemon, hubs: list[tuple[VirtualHub, SimulatedSkin]]) -> None:
        self.daemon, self.hubs = daemon, hubs

    def tick(self) -> None:
        for hub, skin in self.hubs:
            hub.serve(time.monotonic(), lambda _, skin=skin: skin.scan().counts)  # type: ignore[misc]
        self.daemon.tick(time.monotonic(), self.daemon.take())

    def until(self, holds: Callable[[], bool]) -> None:
        until(holds, self.tick)


@pytest.fixture(params=[True, False], ids=["one bus", "two"])
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[TwoHubs]:
    skins = [layouts.load(SPEC), layouts.load(SECOND)]
    wired = [joint(skins)] if request.param else skins
    simulated = [SimulatedSkin(layout, seed=k) for k, layout in enumerate(wired)]
    tables = [f'layout = "{spec}"\nstate_dir = "{tmp_path / "state"}"' for spec in (SPEC, SECOND)]
    devices = [tmp_path / f"skin{k}" for k in ((0, 0) if request.param else (0, 1))]
    text = links(*(f"{t}\n{source(d)}" for t, d in zip(tables, devices, strict=True)))
    path = tmp_path / "skins.toml"
    path.write_text(SERVED + text, encoding="utf-8")
    with ExitStack() as opened:
        hubs = [
            opened.enter_context(VirtualHub(device, skin.modules, native=True))
            for device, skin in zip(devices, simulated, strict=False)
        ]
        config = load(path)
        recorder = opened.enter_context(recorder_of(config, path, tmp_path / "session"))
        daemon = Daemon(config, recorder)
        opened.callback(daemon.close)
        daemon.kept.restore()
        yield TwoHubs(daemon, [*zip(hubs, simulated, strict=True)])


def test_touches_of_two_links_are_one_beliefs(rig: TwoHubs, tmp_path: Path) -> None:
    pipeline, one_bus = rig.daemon.pipeline, len(rig.hubs) == 1
    whys = pipeline.freshness.of_links
    rig.until(lambda: whys(time.monotonic()) == [Why.VALID, Why.VALID])
    assert len(rig.daemon.inputs.sources) == 2 - one_bus
    assert [stage.skin.wiring.foreign for stage in pipeline.stages] == [(), ()]
    for k in range(2):
        skin, at = (rig.hubs[0][1], 80 * k) if one_bus else (rig.hubs[k][1], 0)
        skin.press[at + 40 : at + 43] = 12_000.0
        rig.until(lambda k=k: pipeline.estimate.contacts == k + 1)  # type: ignore[misc]
        assert pipeline.estimator.used is None or pipeline.estimator.used.link == k
        rig.until(lambda k=k: pipeline.stages[k].skin.touched)  # type: ignore[misc]
        skin.press[:] = 0.0
        rig.until(lambda: not pipeline.estimate.contact)
    rig.daemon.close()
    rig.daemon.recorder.__exit__()
    with np.load(tmp_path / "state" / "kept.npz") as kept:
        assert {"skin0.baseline", "skin1.baseline"} <= set(kept)
    session = tmp_path / "session"
    again = replay.open_pipeline(session, load(session / "config.toml"))
    found = list(replay.outcomes(session, again))
    assert {outcome.link for outcome in found} == {0, 1}
    scans = [stage.skin.counters.scans for stage in again.stages]
    assert scans == pytest.approx([s.skin.counters.scans for s in pipeline.stages], abs=2)
    assert again.estimate.contacts == pipeline.estimate.contacts == 2


def test_a_robots_clock_that_is_behind_the_other_ones_was_not_set(tmp_path: Path) -> None:
    """A replay takes the poses of both links as the loop did."""
    with Recorder(tmp_path, moves=True) as recorder:
        for t in np.arange(1e9, 1e9 + 1.0, 0.01):
            for link, behind_s in enumerate((0.0, 0.3)):
                recorder.take(SensorPose(t - behind_s, 0.3, 0.1, 0.2), link, t)
    tables = (f'layout = "{SPEC}"\n{source(tmp_path / str(k))}' for k in range(2))
    again = replay.open_pipeline(tmp_path, parse(links(*tables)))
    assert list(replay.outcomes(tmp_path, again)) == []
    assert [stage.poses.taken for stage in again.stages] == [100, 100]
    assert [stage.inputs.clock_steps for stage in again.stages] == [0, 0]


def test_two_links_of_the_same_modules_are_not_on_one_bus(tmp_path: Path) -> None:
    with VirtualHub(tmp_path / "skin", SimulatedSkin(layouts.load(SPEC)).modules, native=True):
        table = f'layout = "{SPEC}"\n{source(tmp_path / "skin")}'
        text = SERVED + links(table, table)
        refuses("link1 and link2 are on one bus, and both have module", Daemon, parse(text))
        assert [fault for fault in check.faults(parse(text)) if "skin.layout" in fault] == [
            "skin.layout: link1 and link2 are on one bus, and both have module 1; "
            "give each link its own modules, or its own [skin.source]"
        ]


RING = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
AWAY = np.array([0.5, 0.0, 0.0])


@pytest.fixture(scope="module")
def model() -> ObservationModel:
    ring = layouts.load(RING)
    return bundle.load("box", ring, further=[ring]).model


def press(subject: Estimator, model: ObservationModel, links: list[int]) -> None:
    """Each link at another side of the box."""
    world = World(model)
    for k, link in enumerate(links):
        world.press(subject, 0.2 + 1.35 * k, link=link)


def subject_of(model: ObservationModel) -> Estimator:
    return Estimator(
        model, Table(model, 4000), FilterConfig(), beside=[Table(model.links[1], 4000)]
    )


def test_touches_of_two_links_find_one_object(model: ObservationModel) -> None:
    """A contact has one number on all links, and a sure belief teaches each link of its own."""
    subject = subject_of(model)
    press(subject, model, [0, 1, 0, 1, 0, 1])
    estimate, memory = subject.estimate, subject.belief.memory
    assert estimate.contacts == 6
    assert estimate.status == Status.CONVERGED
    assert subject.belief.metric.distance(estimate.map, TRUTH) < 0.01
    assert memory.link[memory.contact].tolist() == [0, 1, 0, 1, 0, 1]
    assert memory.number[memory.contact].tolist() == [1, 2, 3, 4, 5, 6]
    lessons = [subject.taught(4, link) for link in (0, 1)]
    assert all(lesson is not None and len(lesson.z) >= 3 for lesson in lessons)
    assert subject.taught(4, 1) is None
    numpy = [NumpyExplainer(each, memory.skin.noise) for each in model.links]
    slow = Memory(replace(memory.skin, explainers=numpy)).adopted(memory)
    explained = (each.explain(subject.belief.particles.pose).scans for each in (slow, memory))
    assert np.isclose(*explained, atol=0.01).mean() > 0.99


def test_a_link_that_never_touches_changes_nothing(model: ObservationModel) -> None:
    alone = bundle.load("box", model.layout).model
    one = Estimator(alone, Table(alone, 4000), FilterConfig())
    two = subject_of(model)
    press(one, alone, [0] * 4)
    press(two, model, [0] * 4)
    assert np.array_equal(one.estimate.map, two.estimate.map)
    assert one.estimate.p == two.estimate.p


def test_links_of_other_sizes_are_remembered_together() -> None:
    big, small = layouts.load(RING), layouts.load(RING.replace("rows=5", "rows=3"))
    scene = bundle.load("box", big).model.scene
    model = ObservationModel(scene, big, 0.005, [ObservationModel(scene, small, 0.005)])
    subject = subject_of(model)
    press(subject, model, [0, 1, 0, 1, 1, 0])
    assert subject.belief.metric.distance(subject.estimate.map, TRUTH) < 0.01


def test_a_link_that_falls_silent_in_a_touch_touches_nothing_any_more(
    model: ObservationModel,
) -> None:
    subject = subject_of(model)
    seen = box_side(model.links[1], 0.3, 0.003)
    sensor = se2.compose(TRUTH, seen)
    z = model.links[1].activation(se2.inverse(seen)[None])[0]
    live = np.ones(len(z), dtype=np.bool_)
    found = [
        subject.on_scan(Activation(t, pressed * z, live), sensor + away, link).contact
        for t, pressed, away, link in (
            (0.0, 1.0, 0.0, 1),
            (0.05, 1.0, 0.0, 1),
            (0.5, 0.0, AWAY, 0),
            (2.0, 0.0, AWAY, 0),
        )
    ]
    assert found == [True, True, True, False]
