"""A calibration's file: written, read, refused in one line, and kept with sessions."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from taxeld.config.file import load, parse
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.response import GRID, Inverse, response
from taxeld.pipeline.poses import PoseTrack
from taxeld.pipeline.stage import calibrated
from taxeld.service import calibration_file
from taxeld.skin.calibration import DAY_S, Calibration
from taxeld.skin.skin import Skin
from taxeld.source.recorder import Recorder
from taxeld_protocol.frames import Frame
from tests.rig.configurations import QUIET, configuration
from tests.rig.simulated_skin import SimulatedSkin
from tests.rig.skins import CALIBRATED_S as NOW
from tests.rig.skins import calibration_of

OTHER = layouts.load("cylinder:rows=5,columns=14,radius_m=0.04,pitch_m=0.015")


def written(skin: Layout, place: Path, calibration: Calibration) -> Path:
    place.write_text(calibration_file.dump(calibration, skin), encoding="utf-8")
    return place


def loaded(path: Path, skin: Layout, now: float = NOW, *, recorded: bool = False) -> Calibration:
    found = calibration_file.load(SkinConfig(calibration=str(path)), skin, now, recorded=recorded)
    assert found is not None
    return found


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
    with pytest.raises(SetupError, match=rf"^skin\.calibration: c: .*{what}[^\n]*; {cure}$"):
        loaded(tmp_path / "c", skin, now)


@pytest.mark.parametrize(("name", "what"), [("nothing", "unreadable"), (".", "no regular")])
def test_a_name_of_no_file_is_refused(skin: Layout, tmp_path: Path, name: str, what: str) -> None:
    with pytest.raises(SetupError, match=rf"^skin\.calibration: .*{what}"):
        loaded(tmp_path / name, skin)


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
    used = load(session / "config.toml").skin.calibration
    assert used == str(session / "c.toml") or not kept


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
        reading = response(np.full(4, h), bend, onset)
        assert inverse(reading)[rising] == pytest.approx(h, abs=4e-3)


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
