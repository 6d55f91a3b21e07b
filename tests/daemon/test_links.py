"""Skins of several links that touch one object: one belief, whatever one of them does."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from taxeld.commands import check, replay
from taxeld.commands.record import recorder_of
from taxeld.config.file import load, parse
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.pipeline.freshness import Why
from taxeld.service.loop import Daemon
from taxeld.source.links import joint
from tests.rig.clocks import until
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.virtual_hub import VirtualHub

SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
SECOND = SPEC + ",sui=9"
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
        self.daemon.tick(time.monotonic())

    def until(self, holds: Callable[[], bool]) -> None:
        until(holds, self.tick)


@pytest.fixture
def open_links(tmp_path: Path) -> Iterator[Callable[[bool], TwoHubs]]:
    opened: list[TwoHubs] = []

    def make(one_bus: bool) -> TwoHubs:
        skins = [layouts.load(SPEC), layouts.load(SECOND)]
        wired = [joint(skins)] if one_bus else skins
        simulated = [SimulatedSkin(layout, seed=k) for k, layout in enumerate(wired)]
        hubs = [
            (VirtualHub(tmp_path / f"skin{k}", skin.modules, native=True), skin)
            for k, skin in enumerate(simulated)
        ]
        tables = [
            f'layout = "{spec}"\nstate_dir = "{tmp_path / "state"}"' for spec in (SPEC, SECOND)
        ]
        devices = [tmp_path / f"skin{k}" for k in ((0, 0) if one_bus else (0, 1))]
        text = links(*(f"{t}\n{source(d)}" for t, d in zip(tables, devices, strict=True)))
        served = '[publish]\nendpoints = []\n[control]\nendpoint = ""\n'
        path = tmp_path / "skins.toml"
        path.write_text(served + text, encoding="utf-8")
        config = load(path)
        recorder = recorder_of(config, path, tmp_path / "session")
        found = TwoHubs(Daemon(config, recorder), hubs)
        opened.append(found)
        return found

    yield make
    for each in opened:
        each.daemon.close()
        for hub, _ in each.hubs:
            hub.unplug()


@pytest.mark.parametrize("one_bus", [True, False])
def test_touches_of_two_links_are_one_beliefs(
    open_links: Callable[[bool], TwoHubs], one_bus: bool, tmp_path: Path
) -> None:
    rig = open_links(one_bus)
    pipeline = rig.daemon.pipeline
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
    with np.load(tmp_path / "state" / "kept.npz") as kept:
        assert {"skin0.baseline", "skin1.baseline"} <= set(kept)
    session = tmp_path / "session"
    again = replay.open_pipeline(session, load(session / "config.toml"))
    found = list(replay.outcomes(session, again))
    assert {outcome.link for outcome in found} == {0, 1}
    scans = [stage.skin.counters.scans for stage in again.stages]
    assert scans == pytest.approx([s.skin.counters.scans for s in pipeline.stages], abs=2)
    assert again.estimate.contacts == pipeline.estimate.contacts == 2
    (session / "link2").mkdir()  # as older sessions have it
    with pytest.raises(SetupError, match=r"link2: .*; record it anew$"):
        next(replay.outcomes(session, again))


def test_two_links_of_the_same_modules_are_not_on_one_bus(tmp_path: Path) -> None:
    with VirtualHub(tmp_path / "skin", SimulatedSkin(layouts.load(SPEC)).modules, native=True):
        table = f'layout = "{SPEC}"\n{source(tmp_path / "skin")}'
        text = '[publish]\nendpoints = []\n[control]\nendpoint = ""\n' + links(table, table)
        with pytest.raises(
            SetupError, match="link1 and link2 are on one bus, and both have module"
        ):
            Daemon(parse(text))
        assert [fault for fault in check.faults(parse(text)) if "skin.layout" in fault] == [
            "skin.layout: link1 and link2 are on one bus, and both have module 1; "
            "give each link its own modules, or its own [skin.source]"
        ]
