"""The skin, object and scenario of most tests; and a skin of known gains that is pressed."""

import shutil
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.layout import read as layouts
from taxeld.model import contacts, se2
from taxeld.model.observation import ObservationModel
from taxeld.model.response import response
from taxeld.proposals import bundle
from taxeld.source.recorder import Recorder
from taxeld_hil.calibration.fit import depths
from taxeld_hil.calibration.presses import Presses
from taxeld_hil.grade.grade import Grade
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Scenario
from taxeld_protocol.modules import wired
from taxeld_protocol.virtual_ihb import VirtualIhb
from tests.rig.simulated_skin import PERIOD_S, SimulatedSkin
from tests.rig.virtual_hub import frames_of, told

DEMO = scenario.load("demo")
SKIN = layouts.load(DEMO.skin_layout)
MODEL = bundle.load("box", SKIN, 0.005).model
MODULES = wired(SKIN.uid.tolist())
TRUTH = np.array([0.05, -0.1, 0.7])  # pose of a touched object
PLACED = np.array([0.05, -0.04, 0.6])  # pose of the object that calibrates
BASE, HELD_S = 10_000, 0.4
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)  # turns between stretches of skin: even at any count
FIRM = 0.4  # of full scale: a corner between two columns is pressed less


def passing(
    subject: Scenario, place: Path | None = None, luck: tuple[str, ...] = ()
) -> tuple[FakeRun, Grade]:
    """A run on the fake clock that passes, but for checks left to `luck`; its session in `place`.

    Chance decides which frames a fault hits and what few touches tell: where the first run fails,
    three of five must pass. In each of them nothing is lost without being counted.
    """
    failures = list[list[str]]()
    for seed in count():
        if place is not None:
            shutil.rmtree(place, ignore_errors=True)
        run = FakeRun(subject, seed, rate_hz=40.0)
        grade = run.graded("any", place)
        assert all(law["holds"] for law in grade.figures["laws"])
        failed = [f"{c.name}: {c.detail}" for c in grade.checks if c.passed is False]
        if not all(each.startswith(luck) for each in failed):
            failures.append(failed)
        elif not failures or seed == len(failures) + 2:
            return run, grade
        assert len(failures) < 3, failures
    raise AssertionError


@dataclass(frozen=True)
class PressedSkin:
    """M taxels, and K places of the sensor at which it presses."""

    model: ObservationModel
    sensor: Poses  # (K, 3) of the sensor itself
    mount: Poses
    full_scale: float
    gain: Floats
    onset: Floats
    bend: float
    noise: float

    @classmethod
    def drawn(cls, model: ObservationModel, seed: int, presses: int = 20) -> "PressedSkin":
        rng, taxels, scene = np.random.default_rng(seed), len(model.layout), model.scene
        held: list[Poses] = []
        while len(held) < presses:  # round the object, with every side of the skin in turn
            angle = 2.0 * np.pi * (len(held) + rng.uniform(-0.3, 0.3)) / presses
            ahead = np.array([np.cos(angle), np.sin(angle)])
            aside = 0.35 * rng.uniform(-1.0, 1.0) * np.array([-ahead[1], ahead[0]])
            x, y = (scene.centre + scene.size * (ahead + aside))[:, None]
            yaw = np.pi + angle - 2.0 * np.pi * GOLDEN * len(held)
            beside, depth_m = contacts.pose_of_axis(x, y, -yaw), rng.uniform(0.0034, 0.0048, 1)
            press, _ = contacts.project(scene, model.layout.radius_m, beside, depth_m)
            if model.activation(press).max() > FIRM:
                held += [*press]
        return cls(
            model,
            se2.compose(PLACED, se2.inverse(np.array(held))),
            rng.uniform(-1.0, 1.0, 3) * [0.004, 0.004, 0.07],
            float(rng.uniform(12_000.0, 30_000.0)),
            np.exp(0.15 * rng.standard_normal(taxels)),
            0.1 + 0.5 * rng.standard_normal(taxels),
            float(rng.uniform(-0.05, 0.15)),
            20.0,
        )

    @property
    def told(self) -> Poses:
        """(K, 3) what the robot says."""
        return se2.compose(self.sensor, se2.inverse(self.mount))

    def counts(self, sensor: Poses) -> Floats:
        """(K, M) over baseline, at poses of the sensor itself."""
        h = depths(self.model, se2.compose(se2.inverse(sensor), PLACED))
        return self.full_scale * self.gain * response(h, self.bend, self.onset)

    def presses(self, seed: int = 0) -> Presses:
        counts = self.counts(self.sensor)
        counts = counts + self.noise * np.random.default_rng(seed).standard_normal(counts.shape)
        return Presses(self.told, counts, np.ones_like(counts, dtype=bool))


def write_session(
    directory: Path, skin: PressedSkin, idle_s: float = 12.0, frozen: tuple[int, ...] = ()
) -> None:
    """A CAN session of that skin, from 100 s on: idle, then each press held, and away between."""
    simulated, hub = SimulatedSkin(skin.model.layout, 1, skin.noise), VirtualIhb(MODULES)
    simulated.fixed = dict.fromkeys(frozen, BASE)
    away, t = np.array([0.6, 0.6, 0.0]), 100.0
    stays = [(away, idle_s)]
    for told_at in skin.told:
        stays += [(told_at, HELD_S), (away, 0.25)]
    with Recorder(directory, moves=True) as recorder:
        for frame in frames_of(told(hub), t=t):
            recorder.take(frame)
        for told_at, seconds in stays:
            simulated.press = skin.counts(se2.compose(told_at, skin.mount)[None])[0]
            for _ in range(round(seconds / PERIOD_S)):
                t += PERIOD_S
                for at in (t - 0.03, t):
                    recorder.take((at, *told_at.tolist()))
                for frame in frames_of(hub.sensor_data(simulated.scan().counts), t=t):
                    recorder.take(frame)
    (directory / "config.toml").write_text(
        '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
        '[filter]\nproposal = "manifold"\nparticles = 60\nparticles_max = 60\ninjected = 20\n',
        encoding="utf-8",
    )
