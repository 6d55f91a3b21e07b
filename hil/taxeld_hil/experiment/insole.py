"""`taxeld-hil physics --fit`: what recordings of an insole under even air pressure say of taxels.

Belli et al. 2023 (Sensors 23(9) 4501) recorded 280 capacitive taxels of 8 bit at 50 Hz, whose codes
fall with pressure, and the pressure beside them, by another clock. From each recording come the
common response, by how much taxels differ from it, their loops and their noise at rest.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taxeld.arrays import Floats
from taxeld.errors import SetupError
from taxeld_hil.world.electronics import deviation

RATE_HZ = 50.0
REST = 200  # samples at the start, without pressure
JUMP_CODES, JUMP_SAMPLES = 25.0, 5
REST_LEAST, SPAN = 150.0, (12.0, 90.0)  # codes of a sound taxel
SPIKES = 25  # samples over which spikes of the pressure are taken away
LAG_MAX = 150  # samples
STEP = 50  # samples, over which a change is looked at
LEVELS = 20  # of pressure, in each of which readings are averaged,
ENOUGH = 30  # where there are so many
ONCE = 2.6  # a recording that rises and falls once has travelled less, in spans of its pressure


@dataclass(frozen=True, slots=True)
class Fit:
    """Of one recording; shares are of a taxel's full response."""

    recording: str
    taxels: int  # sound ones
    broken: int
    lag_s: float  # of the readings behind the pressure, by their steps
    full_bar: float
    bend: float  # of the common response
    onset: tuple[float, float]  # median and 90th percentile of the taxels'
    gain_cv: float
    own_gain_leaves: float  # rms of all samples, noise and loops within
    common_gain_leaves: float
    taxels_differ: float  # rms of readings averaged by pressure, with each taxel's own gain
    onset_explains: float  # share of that variance
    loop: tuple[float, float] | None  # median and 90th percentile; None: it did not rise and fall
    least_lag_s: float  # at which both are most alike: it takes a part of the loop for delay,
    least_loop: tuple[float, float] | None  # and this is what is left of it
    rest_noise: float  # median
    curve: list[float]  # the common response, at LEVELS middles of pressure


def fit(place: Path) -> list[Fit]:
    """All recordings of a directory.

    Raises:
        SetupError: scipy is missing, or a file is no such recording.
    """
    return [_fit(path.stem, *_load(path)) for path in sorted(place.glob("*.mat"))]


def lines(fits: list[Fit]) -> Iterator[str]:
    """A Markdown table, a column a recording."""

    def pair(values: tuple[float, float] | None, unit: float = 1.0) -> str:
        return "–" if values is None else " / ".join(f"{unit * v:.3g}" for v in values)

    yield "| | " + " | ".join(f.recording for f in fits) + " |"
    yield "|---" * (len(fits) + 1) + "|"
    rows = {
        "taxels, broken ones": [f"{f.taxels}, {f.broken}" for f in fits],
        "lag behind the pressure, s": [f"{f.lag_s:.2f}" for f in fits],
        "bend of the common response": [f"{f.bend:.3f}" for f in fits],
        "onset, median / p90": [pair(f.onset) for f in fits],
        "gain spread": [f"{f.gain_cv:.3f}" for f in fits],
        "own gain leaves, common gain leaves": [
            f"{f.own_gain_leaves:.3f}, {f.common_gain_leaves:.3f}" for f in fits
        ],
        "of it without noise and loops": [f"{f.taxels_differ:.3f}" for f in fits],
        "which onsets explain": [f"{f.onset_explains:.0%}" for f in fits],
        "loop, median / p90, %": [pair(f.loop, 100.0) for f in fits],
        "at the lag that leaves least, s": [f"{f.least_lag_s:.2f}" for f in fits],
        "loop then, median / p90, %": [pair(f.least_loop, 100.0) for f in fits],
        "noise at rest": [f"{f.rest_noise:.3f}" for f in fits],
    }
    for name, cells in rows.items():
        yield f"| {name} | " + " | ".join(cells) + " |"


def write(path: Path, fits: list[Fit]) -> None:
    rows = ",\n ".join(json.dumps(_rounded(asdict(f)), ensure_ascii=False) for f in fits)
    path.write_text(f"[\n {rows}\n]\n", encoding="utf-8")


def sound(codes: Floats) -> NDArray[np.bool_]:
    """(M,) of readings (T, M): neither jumping, dead, nor hardly or wildly moving."""
    jump = np.abs(codes[JUMP_SAMPLES:] - codes[:-JUMP_SAMPLES]).max(axis=0)
    span = np.ptp(codes, axis=0)
    rest = np.median(codes[:REST], axis=0)
    return np.asarray(
        (jump <= JUMP_CODES) & (rest >= REST_LEAST) & (span >= SPAN[0]) & (span <= SPAN[1])
    )


def lag(pressure: Floats, reading: Floats) -> int:
    """By how many samples a reading (T,) follows the pressure (T,): where they correlate best."""
    return max(
        range(-LAG_MAX, LAG_MAX + 1),
        key=lambda by: float(np.corrcoef(*_shifted(pressure, reading, by))[0, 1]),
    )


def _shifted(pressure: Floats, reading: Floats, by: int) -> tuple[Floats, Floats]:
    """Both of the same moments, where the reading follows by so many samples."""
    n = len(pressure)
    return pressure[max(-by, 0) : n - max(by, 0)], reading[max(by, 0) : n + min(by, 0)]


def _load(path: Path) -> tuple[Floats, Floats]:
    """Codes (T, M) and pressures (T,) [bar]."""
    try:
        from scipy.io import loadmat  # noqa: PLC0415  # this alone needs it
    except ImportError:
        raise SetupError("--fit: scipy is not installed; pip install 'taxeld[train]'") from None
    try:
        record = loadmat(path)["experiment"][0, 0]
        codes, pressure = np.asarray(record["C"])[:, 2:], np.asarray(record["P"])[:, 0]
        n = min(len(codes), len(pressure))
        if n < 2 * (REST + LAG_MAX) or not np.isfinite(codes).all():
            raise ValueError(f"{n} samples")
    except (ValueError, KeyError, IndexError, TypeError, OSError, NotImplementedError) as error:
        raise SetupError(f"{path}: is no recording of an insole ({error})") from None
    return codes[:n].astype(float), pressure[:n].astype(float)


def _fit(name: str, codes: Floats, pressure: Floats) -> Fit:
    good = sound(codes)
    fallen = np.median(codes[:REST], axis=0)[good] - codes[:, good]  # rises with pressure
    noise = fallen[:REST].std(axis=0)
    pressure, mean = _without_spikes(pressure), fallen.mean(axis=1)
    behind = lag(*(row[STEP:] - row[:-STEP] for row in (pressure, mean)))
    alike = lag(pressure, mean)
    response = _Response(*_shifted(pressure, fallen, behind))
    bowed = response.h * (1.0 - response.h)
    shape = np.stack([response.curve, deviation(response.h)], axis=1)
    apart = response.read - response.curve[:, None]
    weights = np.linalg.lstsq(shape, response.read, rcond=None)[0]
    unexplained = response.read - shape @ weights
    samples = np.interp(response.share, response.h, response.curve)[:, None]
    return Fit(
        recording=name,
        taxels=int(good.sum()),
        broken=int((~good).sum()),
        lag_s=behind / RATE_HZ,
        full_bar=response.full_bar,
        bend=float(bowed @ (response.curve - response.h) / (bowed @ bowed)),
        onset=_pair(1.0 + weights[1] / weights[0]),
        gain_cv=float(response.full.std() / response.full.mean()),
        own_gain_leaves=_rms(response.samples / response.full - samples),
        common_gain_leaves=_rms(response.samples / response.full.mean() - samples),
        taxels_differ=_rms(apart),
        onset_explains=1.0 - float((unexplained**2).sum() / (apart**2).sum()),
        loop=response.loop(),
        least_lag_s=alike / RATE_HZ,
        least_loop=_Response(*_shifted(pressure, fallen, alike)).loop(),
        rest_noise=float(np.median(noise / response.full)),
        curve=response.curve.tolist(),
    )


class _Response:
    """Readings (T, M) at pressures (T,) of the same moments, averaged by level of pressure."""

    def __init__(self, pressure: Floats, samples: Floats) -> None:
        rest_bar, self.full_bar = float(np.median(pressure[:REST])), float(pressure.max())
        self.samples = samples
        self.share = np.clip((pressure - rest_bar) / (self.full_bar - rest_bar), 0.0, 1.0)
        self._level = np.minimum((self.share * LEVELS).astype(int), LEVELS - 1)
        self.h = _by_level(self.share[:, None], self._level)[:, 0]
        read = _by_level(samples, self._level)
        common = read.mean(axis=1)
        slope = (common[-1] - common[-2]) / (self.h[-1] - self.h[-2])
        top = common[-1] + slope * (1.0 - self.h[-1])  # at full pressure
        self.full = top * (common @ read) / (common @ common)  # (M,)
        self.curve = common / top
        self.read = read / self.full

    def loop(self) -> tuple[float, float] | None:
        """Median and 90th percentile over taxels of the mean width of their loops."""
        smooth = np.convolve(self.share, np.ones(STEP) / STEP, "valid")
        if np.abs(np.diff(smooth)).sum() > ONCE * np.ptp(smooth):
            return None
        top = int(self.share.argmax())
        rising, falling = (
            _by_level(self.samples[part], self._level[part])
            for part in (slice(0, top), slice(top, None))
        )
        return _pair(np.abs(np.nanmean((falling - rising) / self.full, axis=0)))


def _by_level(read: Floats, level: NDArray[np.intp]) -> Floats:
    """(LEVELS, M) means of readings (T, M) by level (T,); not a number where they are too few."""
    rows = (read[level == k] for k in range(LEVELS))
    nothing = np.full(read.shape[1], np.nan)
    return np.array([row.mean(axis=0) if len(row) >= ENOUGH else nothing for row in rows])


def _without_spikes(pressure: Floats) -> Floats:
    """A running median."""
    padded = np.pad(pressure, SPIKES // 2, mode="edge")
    return np.asarray(np.median(np.lib.stride_tricks.sliding_window_view(padded, SPIKES), axis=1))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _pair(values: Floats) -> tuple[float, float]:
    median, p90 = np.quantile(values, (0.5, 0.9))
    return float(median), float(p90)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
