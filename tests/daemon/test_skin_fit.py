"""What touches teach about taxels: learned from sure beliefs, and never against the evidence."""

from dataclasses import replace

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.config.tables import SkinConfig
from taxeld.model.noise import Noise
from taxeld.model.observation import Lesson
from taxeld.model.response import SAG_M, SAG_SD, Inverse, response, sagging
from taxeld.proposals import bundle
from taxeld.skin.fit import SkinFit
from taxeld.skin.skin import Skin
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from tests.rig.simulated_skin import begun
from tests.rig.skins import SKIN, calibration_of

TAXELS = 60
NOISE = Noise(0.04, 0.17, sag_m=SAG_M, sag_sd=SAG_SD)


class Taught:
    """Taxels of true gains and onsets, read by the curves that have been learned."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.gain = 1.0 + 0.17 * self.rng.standard_normal(TAXELS)
        self.onset = self.rng.uniform(-0.4, 0.9, TAXELS)
        self.fit = SkinFit(TAXELS, NOISE)

    def lesson(self, contacts: int = 8, wrong: float = 1.0) -> Lesson:
        """Contacts at depths that the belief takes for `wrong` times as deep."""
        depth = self.rng.uniform(0.05, 0.9, (contacts, TAXELS))
        reading = self.gain * response(depth, 0.0, self.onset)
        reading += 0.01 * self.rng.standard_normal(depth.shape)
        gain, onset, _ = self.fit.fit.mean
        inverse = Inverse(self.fit.bend, onset)
        z = np.stack([inverse(np.clip(row / gain, 0.0, 1.0)) for row in reading])
        none = np.zeros(depth.shape)
        return Lesson(z, none + 0.01, wrong * depth, none, none + 1e-5, none == 0.0, none[:, 0] + 1)

    @property
    def error(self) -> float:
        """Of the curves, in shares of full scale."""
        gain, onset, _ = self.fit.fit.mean
        h = np.linspace(0.05, 0.8, 20)[:, None]
        learned = gain * response(h, 0.0, onset)
        return float(np.sqrt(np.mean((learned - self.gain * response(h, 0.0, self.onset)) ** 2)))


def test_gains_and_onsets_are_learned_and_readings_believed_more() -> None:
    taught = Taught()
    before, noise = taught.error, taught.fit.noise
    for _ in range(6):
        taught.fit.teach(taught.lesson())
    assert taught.error < 0.3 * before
    assert (taught.fit.noise.gain_cv < noise.gain_cv).all()


def test_a_lesson_that_foretells_the_next_one_worse_is_refused() -> None:
    taught = Taught()
    for _ in range(4):
        taught.fit.teach(taught.lesson())
    kept = taught.fit.fit
    taught.fit.teach(taught.lesson(wrong=0.6))  # of a wrong belief; now on trial
    assert taught.fit.teach(taught.lesson()) is False
    assert np.abs(taught.fit.fit.mean - kept.mean).max() < 0.1


def test_a_lesson_of_untouched_and_saturated_taxels_teaches_nothing() -> None:
    fit = SkinFit(TAXELS, NOISE)
    flat = np.zeros((3, TAXELS))
    for z, h in ((0.0, 0.0), (1.0, 1.0), (0.3, 0.0)):
        before = fit.values[:6]
        for _ in range(2):
            fit.teach(
                Lesson(flat + z, flat + 0.01, flat + h, flat, flat, flat == 0.0, flat[:, 0] + 1)
            )
        assert (fit.values[:6] == before).all()


def test_the_length_of_the_sag_is_learned_where_the_cover_sags() -> None:
    rng, fit = np.random.default_rng(0), SkinFit(TAXELS, NOISE)
    for _ in range(8):
        depth, slope = rng.uniform(-0.3, 0.2, (8, TAXELS)), rng.uniform(40.0, 90.0, (8, TAXELS))
        true = sagging(depth, 0.005 * slope)
        rate = np.exp(fit.fit.mean[2]) * slope
        h = sagging(depth, rate)
        z = np.where(true < 0.01, 0.0, true)
        by_sag = h * np.maximum(1.0 - depth / rate, 0.0)
        fit.teach(Lesson(z, 0.01 + 0.0 * z, h, by_sag, 1e-5 + 0.0 * z, z >= 0.0, np.ones(8)))
    learned = np.exp(fit.fit.mean[2])
    assert np.median(learned) == pytest.approx(0.005, rel=0.2)


def answered(fit: SkinFit, answers: Floats, contacts: int, seed: int, depth: float) -> None:
    """Lessons of 12 contacts each, in which every taxel is pressed."""
    rng, none = np.random.default_rng(seed), np.zeros((12, len(answers)))
    for _ in range(contacts // 12):
        z = np.where(rng.random(none.shape) < answers, depth, none)
        lesson = Lesson(z, none + 0.02, none + depth, none, none, none == 0.0, np.ones(12))
        fit.teach(lesson)


@pytest.mark.parametrize(
    ("answers", "depth", "learned"),
    [
        (np.linspace(0.0, 1.0, TAXELS), 0.5, np.linspace(0.0, 1.0, TAXELS)),
        (np.zeros(TAXELS), 0.01, SkinFit(TAXELS, NOISE).noise.answers),  # too light to be felt
    ],
)
def test_the_share_of_presses_that_a_taxel_answers_is_learned(
    answers: Floats, depth: float, learned: Floats
) -> None:
    fit = SkinFit(TAXELS, NOISE)
    answered(fit, answers, 120, seed=1, depth=depth)
    assert np.abs(fit.noise.answers - learned).mean() < 0.1
    assert np.abs(fit.fit.mean[0] - 1.0).max() < 0.1  # a silence tells nothing of the gain


def lived(touches: int, seed: int, of: str = "", *, learns: bool = True) -> tuple[FakeRun, Floats]:
    """A daemon that touches the mug, until it has learned, or if it takes the mug for `of` again
    and again; → it, and the sds of its taxels before."""
    asked = replace(scenario.load("demo").touching("mug").on("typical"), contacts=touches)
    run = FakeRun(asked, seed, rate_hz=40.0)
    run.config = replace(run.config, skin=replace(run.config.skin, learn=learns))
    run.scenes = [bundle.load(of or "mug", run.skin)]
    run.daemon = run._born()
    for tick in range(round(40 * run.duration_s)):
        run.step(tick / 40)
        if not of and run.daemon.pipeline.skin.fit.lessons:
            break
    run.daemon.pipeline.reset()
    return run, SkinFit(len(run.skin), NOISE).values[3:6]


@pytest.mark.check
def test_a_skin_learns_while_it_works_unless_it_is_told_not_to() -> None:
    (run, _), (frozen, _) = lived(96, 5), lived(32, 5, learns=False)
    assert run.daemon is not None
    assert frozen.daemon is not None
    assert run.daemon.pipeline.skin.fit.lessons > 0
    assert frozen.daemon.pipeline.skin.fit.lessons == 0


def test_touches_of_another_object_move_no_response_by_more_than_its_own_sd() -> None:
    run, sd = lived(32, 5, of="box")
    assert run.daemon is not None
    fit = run.daemon.pipeline.skin.fit
    before = SkinFit(len(run.skin), NOISE)
    assert (np.abs(fit.fit.mean - before.fit.mean) <= sd).all()


@pytest.mark.parametrize(
    ("config", "is_calibrated", "gain"),
    [
        (SkinConfig(), False, 1.3),
        (SkinConfig(learn=False), False, 1.0),
        # on another scale: a calibration that was configured later, or another full scale
        (SkinConfig(), True, calibration_of(SKIN).gain),
        (SkinConfig(full_scale_counts=30_000.0), False, 1.0),
    ],
)
def test_what_was_learned_outlasts_a_restart_and_an_old_baseline_on_the_same_scale(
    config: SkinConfig, is_calibrated: bool, gain: Floats | float
) -> None:
    _, subject = begun(SKIN)
    learned = subject.fit.values
    learned[0] *= 1.3
    subject.fit.restore(learned)
    state = subject.state()
    assert state is not None
    calibration = calibration_of(SKIN) if is_calibrated else None
    again = Skin(SKIN, config, calibration=calibration, noise=NOISE)
    again.restore(state, baseline=False)
    assert not again.is_ready
    assert np.allclose(again.fit.values[0], gain)
    assert (again.noise is not None) == (is_calibrated or gain == 1.3)
