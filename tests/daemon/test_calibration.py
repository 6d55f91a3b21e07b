"""A calibration's file, and what touches teach about taxels."""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.config.file import load, parse
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Lesson
from taxeld.model.response import GRID, SAG_M, SAG_SD, Inverse, response, sagging
from taxeld.pipeline.poses import PoseTrack
from taxeld.pipeline.stage import calibrated
from taxeld.proposals import bundle
from taxeld.service import calibration_file
from taxeld.skin.calibration import DAY_S, Calibration
from taxeld.skin.fit import SkinFit
from taxeld.skin.skin import Skin
from taxeld.source.recorder import Recorder
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.scenario import scenario
from taxeld_protocol.frames import Frame
from tests.rig.commands import refuses
from tests.rig.configurations import QUIET, configuration
from tests.rig.simulated_skin import SimulatedSkin, begun
from tests.rig.skins import CALIBRATED_S as NOW
from tests.rig.skins import SKIN, calibration_of

OTHER = layouts.load("cylinder:rows=5,columns=14,radius_m=0.04,pitch_m=0.015")


def written(skin: Layout, place: Path, calibration: Calibration) -> Path:
    place.write_text(calibration_file.dump(calibration, skin), encoding="utf-8")
    return place


def loaded(path: Path, skin: Layout, now: float = NOW, *, recorded: bool = False) -> Calibration:
    config = SkinConfig(calibration=str(path))
    return calibration_file.load(config, skin, now, recorded=recorded)  # type: ignore[return-value]


def test_what_is_written_is_read(skin: Layout, tmp_path: Path) -> None:
    before = asdict(calibration_of(skin, object='a "box" \\ ü 🙂'))
    after = asdict(loaded(written(skin, tmp_path / "c", Calibration(**before)), skin))
    for name, value in before.items():
        if isinstance(value, str):
            assert after[name] == value
        else:
            np.testing.assert_allclose(after[name], value, rtol=1e-3, atol=5e-3)


REFUSED: dict[str, tuple[Callable[[str], str | bytes], float, str]] = {
    "cut short": (lambda text: text[: len(text) // 2], NOW, "not TOML"),
    "empty": (lambda _: "", NOW, "is required"),
    "no text": (lambda _: bytes(range(256)), NOW, "unreadable"),
    "a number that is none": (
        lambda text: text.replace("full_scale_counts = 18432.1", "full_scale_counts = nan"),
        NOW,
        "full_scale_counts: must be a number",
    ),
    "an endless gain": (
        lambda text: text.replace("gain = ", "gain = inf, onset_was = ", 1),
        NOW,
        "taxel\\[0\\]",
    ),
    "no mount": (lambda text: text[: text.index("[mount]")], NOW, "mount: is required"),
    "a list in place of a table": (
        lambda text: text[: text.index("[mount]")] + "mount = [1, 2]\n",
        NOW,
        "mount",
    ),
    "a taxel too few": (
        lambda text: text[: text.rindex("  {uid")] + text[text.index("]\n") :],
        NOW,
        "is of another layout",
    ),
    "of another layout": (
        lambda _: calibration_file.dump(calibration_of(OTHER), OTHER),
        NOW,
        "is of another layout",
    ),
    "of another version": (
        lambda text: text.replace("version = 1", "version = 2"),
        NOW,
        "is of version 2, not 1",
    ),
    "of another depth": (
        lambda text: text.replace("full_scale_depth_m = 0.005", "full_scale_depth_m = 0.004"),
        NOW,
        "is for skin.full_scale_depth_m = 0.004, not 0.005",
    ),
    "too old": (str, NOW + 181 * DAY_S, "is 181 days old, more than 180"),
    "of the future": (str, NOW - 3 * DAY_S, "from 3 days ahead: set this machine's clock"),
}


@pytest.mark.parametrize(("change", "now", "what"), REFUSED.values(), ids=REFUSED)
def test_a_file_that_cannot_be_used_is_one_line_with_the_cure(
    skin: Layout, tmp_path: Path, change: Callable[[str], str | bytes], now: float, what: str
) -> None:
    content = change(calibration_file.dump(calibration_of(skin), skin))
    (tmp_path / "c").write_bytes(content if isinstance(content, bytes) else content.encode())
    cure = r"calibrate this skin \(taxeld calibrate\), or name its own file"
    refuses(rf"^skin\.calibration: c: .*{what}[^\n]*; {cure}$", loaded, tmp_path / "c", skin, now)


@pytest.mark.parametrize(("name", "what"), [("nothing", "unreadable"), (".", "no regular")])
def test_a_name_of_no_file_is_refused(skin: Layout, tmp_path: Path, name: str, what: str) -> None:
    refuses(rf"^skin\.calibration: .*{what}", loaded, tmp_path / name, skin)


def test_a_calibration_holds_180_days_and_for_what_was_recorded_before_it(
    skin: Layout, tmp_path: Path
) -> None:
    path = written(skin, tmp_path / "c.toml", calibration_of(skin))
    loaded(path, skin, NOW + 179 * DAY_S)
    loaded(path, skin, NOW - 3 * DAY_S, recorded=True)


@pytest.mark.parametrize(
    ("named", "kept"), [("c.toml", ["c.toml"]), ("../c.toml", [])], ids=["beside", "elsewhere"]
)
def test_a_session_keeps_the_calibration_that_lies_beside_its_configuration(
    skin: Layout, tmp_path: Path, named: str, kept: list[str]
) -> None:
    place, session = tmp_path / "robot", tmp_path / "session"
    place.mkdir()
    source = written(skin, place / named, calibration_of(skin))
    config = configuration(place, skin={"calibration": named}, source=QUIET)
    calibration = Path(load(config).skin.calibration)
    with Recorder(session, moves=False, config=config, calibration=calibration) as recorder:
        recorder.take(Frame(NOW, 0x100, b"\x00" * 8))
    files = {path.name: path.read_bytes() for path in session.iterdir()}
    assert files.keys() == {*kept, "config.toml", "arrivals"}
    assert [files[name] for name in kept] == [source.read_bytes()] * len(kept)
    assert load(session / "config.toml").skin.calibration == str(session / "c.toml") or not kept


TEXT = '[scene]\nbundle = "box"\n[source]\nkind = "can"\nchannel = "can0"\n'


@pytest.mark.parametrize("depth", [0.2, 0.5, 0.8])
def test_a_reading_becomes_the_depth_that_was_pressed(skin: Layout, depth: float) -> None:
    c = calibration_of(skin, frozen=np.zeros(len(skin), dtype=bool))
    simulated, subject = SimulatedSkin(skin, noise=0.0), Skin(skin, SkinConfig(), calibration=c)
    simulated.run(subject, 3.0)
    shape = response(np.full(len(skin), depth), c.bend, c.onset)
    rising = shape > 0.1  # an onset that falls below is none of a real taxel
    simulated.press = c.full_scale_counts * c.gain * shape
    assert simulated.run(subject, 0.05).z[rising] == pytest.approx(depth, abs=0.03)


@pytest.mark.parametrize("bend", [-0.3, 0.0, 0.1])
def test_a_response_is_undone_by_its_inverse_and_full_scale_is_exactly_full_depth(
    bend: float,
) -> None:
    """So that a reading of full scale counts as saturated."""
    onset = np.array([-0.5, 0.0, 0.4, 2.5])
    inverse = Inverse(bend, onset)
    assert (inverse(np.full(4, 1.7)) == 1.0).all()
    rising = np.diff(response(GRID, bend, onset[:, None]), axis=1).min(axis=1) > 0.0
    for h in GRID[::16]:
        assert inverse(response(np.full(4, h), bend, onset))[rising] == pytest.approx(h, abs=4e-3)


def test_taxels_have_the_calibrations_noise_and_the_frozen_ones_are_not_believed(
    skin: Layout,
) -> None:
    calibration = calibration_of(skin, noise_counts=np.full(len(skin), 60.0))
    subject = Skin(skin, SkinConfig(), calibration=calibration)
    activation = SimulatedSkin(skin).run(subject, 1.3)
    assert subject.threshold == pytest.approx(360.0, rel=0.02)
    assert np.flatnonzero(~activation.live).tolist() == subject.faults()["stuck_taxels"] == [7]


def test_the_sensors_pose_is_the_robots_with_the_mount() -> None:
    mount = np.array([0.01, -0.02, 0.3])
    track = PoseTrack(mount=mount)
    for t in (1.0, 1.1):
        track.add(t, 0.1, 0.2, 0.5)
    assert track.at(1.05) == pytest.approx(se2.compose(np.array([0.1, 0.2, 0.5]), mount))
    assert track.at(9.0) is None


def test_measured_noise_takes_the_place_of_defaults_and_of_nothing_else(skin: Layout) -> None:
    calibration, usual = calibration_of(skin), FilterConfig()
    used = calibrated(parse(TEXT), calibration)
    assert (used.filter.noise_sigma, used.filter.gain_cv) == (0.045, 0.11)
    assert used.skin.full_scale_counts == calibration.full_scale_counts
    assert calibrated(parse(TEXT), None).filter == usual


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
    assert np.median(np.exp(fit.fit.mean[2])) == pytest.approx(0.005, rel=0.2)


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
    run.run(lambda: not of and run.daemon.pipeline.skin.fit.lessons > 0)
    run.daemon.pipeline.reset()
    return run, SkinFit(len(run.skin), NOISE).values[3:6]


@pytest.mark.check
def test_a_skin_learns_while_it_works_unless_it_is_told_not_to() -> None:
    (run, _), (frozen, _) = lived(96, 5), lived(32, 5, learns=False)
    assert run.daemon.pipeline.skin.fit.lessons > 0
    assert frozen.daemon.pipeline.skin.fit.lessons == 0


def test_touches_of_another_object_move_no_response_by_more_than_its_own_sd() -> None:
    run, sd = lived(32, 5, of="box")
    fit = run.daemon.pipeline.skin.fit
    assert (np.abs(fit.fit.mean - SkinFit(len(run.skin), NOISE).fit.mean) <= sd).all()


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
    calibration = calibration_of(SKIN) if is_calibrated else None
    again = Skin(SKIN, config, calibration=calibration, noise=NOISE)
    again.restore(state, baseline=False)
    assert not again.is_ready
    assert np.allclose(again.fit.values[0], gain)
    assert (again.noise is not None) == (is_calibrated or gain == 1.3)
