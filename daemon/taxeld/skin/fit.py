"""What touches teach about each taxel: gain, onset of its response, sag, and whether it answers.

A sure belief says how deep each taxel was pressed, so its readings say how it responds. Each taxel
has a Gaussian over three numbers (`model.response`): the relative gain, the onset of its own curve,
and the logarithm of the length by which the cover sags beside it. A reading is one step of an
extended Kalman filter. On real skins many taxels stay silent under a press, always the same ones,
so the share of presses that a taxel answers is learned too, as a beta distribution. At a depth that
is felt with probability t, a silence has the likelihood 1 - answers·t; it counts for as much of a
press as gives this likelihood's slope. A lesson is a trial first: it stays only where it foretells
the readings of the next lesson better than what was known before (prequential; Dawid 1984).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from taxeld.arrays import Floats
from taxeld.model.noise import Noise, normal_cdf
from taxeld.model.observation import Lesson
from taxeld.model.response import SAG_M, SAG_SD, deviation, response
from taxeld.skin.calibration import Calibration

STEP = 1e-3  # of depth, for the slope of a response
LEAST_RISE = 0.2  # least slope of a response: a flatter one tells no depth
ONSET_SD = 0.5  # sd of a taxel's onset before anything is learned
WITHIN = 0.5  # share of the variance of readings in a lesson that no curve explains
KNOWN = 0.7  # share of the usual sd: a taxel whose gain is known better was learned
LEAST_SD = 0.02  # least sd of a gain or onset
WITHIN_CV = 0.08  # sd of a reading in proportion to it, however well the gain is known
OWN = 0.5  # share of the sag's variance that is the taxel's own; the rest is a press's
ROBUST = 2.0  # standard deviations beyond which a reading teaches less (Huber 1964)
LEAST = np.array([[0.4], [-0.9], [np.log(2e-4)]])  # least gain, onset, log length
MOST = np.array([[2.5], [3.0], [np.log(0.012)]])
FIRM = 2.0  # standard deviations over the floor of an expected depth that must be answered
RELIABLE = 0.998  # greatest share of presses that a taxel is taken to answer
ANSWERED = 2.0  # presses that this mean, or a calibration's, counts for


class LinearLesson(NamedTuple):
    """A lesson as readings that are linear in each taxel's three numbers."""

    value: Floats  # (K, M) `slope` times the three numbers, plus an error
    slope: Floats  # (K, 3, M)
    variance: Floats  # (K, M) of the error; infinite where a reading tells nothing
    answered: Floats  # (K, M) share of a press that was answered
    silent: Floats  # (K, M) share of a press that was not
    felt: Floats  # (K, M) probability that it would be felt


@dataclass(frozen=True, slots=True)
class TaxelFit:
    """What is known of M taxels."""

    mean: Floats  # (3, M) relative gain, onset, logarithm of the sag's length [m]
    cov: Floats  # (3, 3, M)
    count: Floats  # (2, M) of presses that were answered, and that were not

    @property
    def answers(self) -> Floats:
        """(M,) probability that a taxel answers a press."""
        return np.asarray(self.count[0] / self.count.sum(axis=0))

    def learned(self, seen: LinearLesson) -> "TaxelFit":
        """What is known after these readings."""
        mean, cov = self.mean, self.cov
        for value, slope, variance in zip(*seen[:3], strict=True):
            across = np.einsum("ijm,jm->im", cov, slope)
            spread = np.einsum("im,im->m", slope, across)
            left = value - np.einsum("im,im->m", slope, mean)
            far = ROBUST * np.sqrt(spread + variance) / np.maximum(np.abs(left), 1e-9)
            gain = across / (spread + variance / np.minimum(far, 1.0) ** 2)
            mean = np.clip(mean + gain * left, LEAST, MOST)
            cov = cov - gain[:, None] * across[None]
        count = self.count.copy()
        for answered, silent, felt in zip(*seen[3:], strict=True):
            missing = count[1] / count.sum(axis=0)
            count += answered, silent * missing * felt / (1.0 - (1.0 - missing) * felt)
        return TaxelFit(mean, cov, count)

    def log_density(self, seen: LinearLesson) -> float:
        """Log-density of these readings; each counts within bounds."""
        left = seen.value - np.einsum("kim,im->km", seen.slope, self.mean)
        spread = np.einsum("kim,ijm,kjm->km", seen.slope, self.cov, seen.slope) + seen.variance
        told = np.isfinite(spread)
        square = np.minimum(left[told] ** 2 / spread[told], (2.0 * ROBUST) ** 2)
        answers = self.answers
        counted = seen.answered * np.log(answers) + seen.silent * np.log1p(-answers * seen.felt)
        return float(counted.sum() - 0.5 * (square + np.log(spread[told])).sum())


class SkinFit:
    """The responses of one skin, as far as they are known."""

    def __init__(self, taxels: int, noise: Noise, calibration: Calibration | None = None) -> None:
        """Of M taxels whose readings have the errors `noise` until more is known; from a
        calibration, or of a skin of which no more is known than its kind."""
        ones = np.ones(taxels)
        gain, onset, answers, self.bend = ones, 0.0 * ones, noise.answers * ones, 0.0
        self._within = min(WITHIN_CV, float(noise.gain_cv))
        sd = np.stack([np.sqrt(noise.gain_cv**2 - self._within**2) * ones, ONSET_SD * ones])
        if calibration is not None:
            gain, onset, self.bend = calibration.gain, calibration.onset, calibration.bend
            answers = calibration.answers
            self._within = float(noise.gain_cv)
            sd = np.stack([calibration.gain_sd, calibration.onset_sd])
        sd = np.vstack([np.maximum(sd, LEAST_SD), np.sqrt(OWN) * SAG_SD * ones])
        self.lessons = 0  # lessons that were kept
        self._noise, self._usual = noise, np.median(sd[0])
        answers = np.clip(answers, 1.0 - RELIABLE, RELIABLE)
        count = ANSWERED * np.stack([answers, 1.0 - answers])
        self.restore(np.vstack([gain, onset, np.log(SAG_M) * ones, sd, count]))

    @property
    def values(self) -> Floats:
        """(8, M) means of gain, onset and the logarithm of the sag's length, their sds, and counts
        of presses that were answered and that were not."""
        sd = np.sqrt(self.fit.cov[np.arange(3), np.arange(3)])
        return np.vstack([self.fit.mean, sd, self.fit.count])

    def restore(self, values: Floats) -> None:
        """Go on from `values` of before a restart."""
        cov = np.eye(3)[:, :, None] * values[3:6] ** 2
        self.fit = TaxelFit(values[:3], cov, values[6:])
        self._trial: TaxelFit | None = None

    @property
    def gain(self) -> float:
        """The median of the learned gains; 1 without any."""
        known = self.fit.cov[0, 0] < (KNOWN * self._usual) ** 2
        return float(np.median(self.fit.mean[0, known])) if known.any() else 1.0

    @property
    def noise(self) -> Noise:
        """The errors of each taxel's readings about its curve, (M,)."""
        cov, usual = self.fit.cov, self._noise
        return Noise(
            sigma=usual.sigma,
            gain_cv=np.sqrt(cov[0, 0] + self._within**2),
            outliers=usual.outliers,
            sag_m=np.exp(self.fit.mean[2]),
            sag_sd=np.sqrt(cov[2, 2] + (1.0 - OWN) * SAG_SD**2),
            answers=self.fit.answers,
        )

    def teach(self, lesson: Lesson) -> bool:
        """Take a lesson; → whether the one before stays, so that the fit has changed."""
        trial, seen, kept = self._trial, self._read(lesson), False
        if trial is not None:
            kept = trial.log_density(seen) > self.fit.log_density(seen)
            self.fit = trial if kept else self.fit
            self.lessons += kept
        self._trial = self.fit.learned(seen)
        return kept

    def _read(self, lesson: Lesson) -> LinearLesson:
        """The lesson, linear about the curves in use."""
        z, h = lesson.z, np.clip(lesson.h, 0.0, 1.0)
        gain, onset, _ = self.fit.mean
        reads = response(h, self.bend, onset)
        beyond = response(h + STEP, self.bend, onset)
        rise = np.maximum((beyond - reads) / STEP, LEAST_RISE)
        felt = (z > 0.0) & (z < 1.0) & (h > 0.0)
        unfelt = (z == 0.0) & (h > lesson.floor)
        off = np.where(felt, z - h, np.where(unfelt, lesson.floor - h, 0.0))
        slope = np.stack([reads / (gain * rise), deviation(h) / rise, lesson.by_sag], axis=1)
        own = WITHIN * np.square(self._noise.sigma) + np.square(self._within * h)
        of_press = (1.0 - OWN) * np.square(SAG_SD * lesson.by_sag)
        variance = own / rise**2 + lesson.variance + of_press
        told = lesson.live & (felt | unfelt)
        value = off + np.einsum("kim,im->km", slope, self.fit.mean)
        noise, answers = self.noise, self.fit.answers
        spread = noise.variance(h) + lesson.variance + np.square(noise.sag_sd * lesson.by_sag)
        over = (h - lesson.floor) / np.sqrt(spread)
        unseen = normal_cdf(-over)
        may_answer = answers * unseen / (1.0 - answers + answers * unseen)
        variance /= np.where(unfelt, may_answer, 1.0)  # a silence tells no depth
        share = lesson.share[:, None] * (lesson.live & (over > FIRM))
        return LinearLesson(
            value=value,
            slope=slope,
            variance=np.where(told, variance, np.inf),
            answered=share * (z > 0.0),
            silent=share * (z == 0.0),
            felt=1.0 - unseen,
        )
