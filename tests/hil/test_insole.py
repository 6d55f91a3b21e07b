"""The fit of insole recordings: what a made-up recording was made of is found again."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld_hil import cli
from taxeld_hil.experiment import insole
from taxeld_hil.scenario.mesh_config import TYPICAL
from taxeld_hil.world.electronics import deviation, mean_response

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("TAXELD_SHARED", ROOT / ".." / "shared")) / "data" / "insole"
KEPT = ROOT / "docs" / "results" / "insole.json"
TAXELS, LAG = 150, 20
scipy_io = pytest.importorskip("scipy.io")


def made(seed: int, loop: float = 0.0) -> tuple[Floats, Floats, Floats, Floats]:
    """Codes (T, M), pressures (T,), onsets (M,) and gains (M,): a rise and a fall after a rest."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(np.linspace(0.05, 1.0, 20), 200)
    share = np.concatenate([np.zeros(400), steps, steps[::-1]])
    share = np.convolve(np.pad(share, 20, mode="edge"), np.ones(41) / 41.0, "valid")
    onset = np.exp(0.3 * rng.standard_normal(TAXELS))
    gain = 40.0 * (1.0 + 0.15 * rng.standard_normal(TAXELS))
    read = mean_response(share[:, None], 0.2) + (onset - 1.0) * deviation(share[:, None])
    read[4400:] += 1.5 * loop * (4.0 * share * (1.0 - share))[4400:, None]  # `loop` on average
    codes = 240.0 - gain * read + rng.standard_normal(read.shape)
    codes = np.vstack([codes[:1]] * LAG + [codes])[: len(codes)]  # it follows the pressure
    return np.round(codes), 0.05 + 3.0 * share, onset, gain


def saved(place: Path, codes: Floats, pressure: Floats) -> Path:
    stamps = np.zeros((len(codes), 2))
    record = {"C": np.hstack([stamps, codes]), "P": pressure[:, None]}
    scipy_io.savemat(place / "made_up.mat", {"experiment": record})
    return place


def test_lag_response_gains_and_noise_are_found_again(tmp_path: Path) -> None:
    codes, pressure, onset, gain = made(0)
    (found,) = insole.fit(saved(tmp_path, codes, pressure))
    assert (found.taxels, found.broken) == (TAXELS, 0)
    assert found.lag_s == pytest.approx(LAG / insole.RATE_HZ, abs=0.05)
    assert found.bend == pytest.approx(0.2, abs=0.05)
    relative = onset - onset.mean() + 1.0  # to the common curve, which is the taxels' mean
    np.testing.assert_allclose(found.onset, np.quantile(relative, [0.5, 0.9]), atol=0.12)
    assert found.onset_explains > 0.9
    assert found.gain_cv == pytest.approx(gain.std() / gain.mean(), abs=0.03)
    assert found.rest_noise == pytest.approx(1.0 / 40.0, rel=0.15)
    assert found.loop is not None
    assert found.loop[0] < 0.006
    assert found.own_gain_leaves < found.common_gain_leaves


@pytest.mark.parametrize("loop", [0.0, 0.03, 0.06])
def test_a_loop_is_told_from_the_lag_by_the_steps_of_the_pressure(
    loop: float, tmp_path: Path
) -> None:
    codes, pressure, _, _ = made(1, loop=loop)
    (found,) = insole.fit(saved(tmp_path, codes, pressure))
    assert found.loop is not None
    assert found.least_loop is not None
    assert found.loop[0] == pytest.approx(loop, rel=0.15, abs=0.005)
    assert found.least_loop[0] <= found.loop[0] + 0.001


def test_broken_taxels_are_left_out() -> None:
    codes, _, _, _ = made(2)
    codes[3000, 0] -= 60.0  # jumps
    codes[:, 1] -= 100.0  # rests too low
    codes[:, 2] = 240.0  # does not move
    codes[:, 3] = 240.0 - 3.0 * (240.0 - codes[:, 3])  # moves too far
    np.testing.assert_array_equal(np.flatnonzero(~insole.sound(codes)), [0, 1, 2, 3])


def test_a_recording_that_goes_up_and_down_again_and_again_has_no_loop(tmp_path: Path) -> None:
    codes, pressure, _, _ = made(3)
    twice = np.vstack([codes, codes[400:]]), np.concatenate([pressure, pressure[400:]])
    (found,) = insole.fit(saved(tmp_path, *twice))
    assert found.loop is None
    assert any("–" in line for line in insole.lines([found]))


def test_without_recordings_the_fit_says_so_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["physics", "--fit", str(tmp_path / "nowhere"), "--out", str(tmp_path)]
    assert cli.main(command) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert (
        printed.err == f"{tmp_path / 'nowhere'}: no recordings (*.mat) there; nothing is fitted\n"
    )
    assert not (tmp_path / "insole.json").exists()


def test_a_file_that_is_no_recording_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "x.mat").write_bytes(b"no matlab file" * 20)
    with pytest.raises(SetupError, match=r"x\.mat: is no recording of an insole"):
        insole.fit(tmp_path)
    (tmp_path / "x.mat").unlink()
    scipy_io.savemat(tmp_path / "y.mat", {"other": np.zeros(3)})
    with pytest.raises(SetupError, match=r"y\.mat: is no recording of an insole"):
        insole.fit(tmp_path)


@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings here")
def test_the_figures_kept_are_those_of_the_recordings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["physics", "--fit", str(DATA), "--out", str(tmp_path)]) == 0
    assert "bend of the common response" in capsys.readouterr().out
    again = json.loads((tmp_path / "insole.json").read_text(encoding="utf-8"))
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    for one, other in zip(again, kept, strict=True):
        assert one.keys() == other.keys()
        for key, value in one.items():
            if isinstance(value, (float, list)):
                np.testing.assert_allclose(value, other[key], rtol=1e-2, atol=1e-4)
            else:
                assert value == other[key]


def test_the_typical_skin_has_the_response_that_was_fitted() -> None:
    """Its onsets are spread more widely: the band is that of all that own gains leave."""
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    assert TYPICAL.bend == pytest.approx(np.median([f["bend"] for f in kept]), abs=0.01)
    assert TYPICAL.onset[0] == pytest.approx(np.median([f["onset"][0] for f in kept]), abs=0.05)
    assert TYPICAL.onset[1] > max(f["onset"][1] for f in kept)
    loops = [f["least_loop"] for f in kept if f["least_loop"]]
    assert TYPICAL.hysteresis[0] <= min(loop[0] for loop in loops)
    assert TYPICAL.hysteresis[1] == pytest.approx(min(loop[1] for loop in loops), rel=0.1)
