"""How likely readings are at a depth: their errors, floors and full scale.

A reading is the depth, times the taxel's gain error, plus noise. Under the taxel's floor it is
reported as 0, and over full scale as 1.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats, Reals

FLOOR = 0.01  # share of full scale: a lighter touch does not constrain the pose
LEAST = 1e-37  # least probability, so that its logarithm is finite
FARTHEST_SD = 8.0  # standard deviations: a reading that is farther off changes nothing more
BOWLING = 1.5976, 0.07056  # coefficients of a logistic function near to the normal distribution's


@dataclass(frozen=True, slots=True)
class Noise:
    """Errors of a reading z around h(q); dimensionless like activations, of all taxels or (M,)."""

    sigma: Floats | float = 0.02  # sd of the additive noise
    gain_cv: Floats | float = 0.17  # sd of a taxel's relative gain error
    outliers: float = 0.01  # probability that a reading has nothing to do with the pose
    sag_m: Floats | float = 0.0  # length by which the cover sags beside a press (`response`)
    sag_sd: Floats | float = 0.0  # sd of that length's logarithm
    answers: Floats | float = 1.0  # probability that a pressed taxel answers at all

    @property
    def least(self) -> float:
        """The least density that any reading can have."""
        return max(self.outliers / 3.0, LEAST)

    def of(self, taxels: Bools) -> "Noise":
        """The errors of the taxels in a mask (M,) alone."""
        own = (self.sigma, self.gain_cv, self.sag_m, self.sag_sd, self.answers)
        sigma, gain_cv, *others = (a[taxels] if np.ndim(a) else a for a in own)  # type: ignore[index]
        return Noise(sigma, gain_cv, self.outliers, *others)

    def draw(self, h: Floats, rng: np.random.Generator) -> Floats:
        """Readings of true activations `h` (any shape)."""
        gain = 1.0 + self.gain_cv * rng.standard_normal(h.shape)
        z = np.minimum(gain * h + self.sigma * rng.standard_normal(h.shape), 1.0)
        is_silent = rng.random(h.shape) >= self.answers if np.min(self.answers) < 1.0 else False
        return np.where((z < FLOOR) | is_silent, 0.0, z)

    def log_density(
        self, z: Reals, h: Reals, floor: Reals | float = FLOOR, residue: Reals | float = 0.0
    ) -> Floats:
        """log p(z | h) of each taxel. All of z, h, floor and residue are of any shapes that
        broadcast, such as (M,) and (N, M), and the result has their common shape; single precision
        is kept.

        Between floor and full scale it is a Gaussian's density. A reading of 0 is censored, and one
        of 1 saturated: their terms are the probabilities of less than the floor, or of more than
        full scale (a tobit model). With probability `outliers` a reading means nothing, and is 0, 1
        or anything between alike, so a single broken taxel costs a pose a bounded amount. A taxel
        may also fail to answer, and read 0: P(0) = (1 - answers) + answers · P(under the floor).
        That it did answer is as likely at every depth, and is left out.
        """
        variance = self.variance(h) + residue * residue
        off = (np.where(z > 0.0, z, floor) - h) / np.sqrt(variance)
        return self.log_of(z, off, variance, self.quiet(z))

    def quiet(self, z: Reals) -> Floats:
        """Probability (…, M) that a reading z (…, M) is 0 at any depth; 0 where it is not 0."""
        return np.asarray((1.0 - self.answers) * (z <= 0.0))

    def variance(self, h: Reals) -> Floats:
        """Variance of a reading about its true activation `h` (any shape); → the same shape."""
        return np.asarray(np.square(self.sigma) + np.square(self.gain_cv * h))

    def log_of(self, z: Reals, off: Reals, variance: Reals, quiet: Reals | float = 0.0) -> Floats:
        """`log_density` for readings z that lie `off` standard deviations over the expected; a
        reading of 0 has its floor in its place. All have shapes that broadcast, as (P,)."""
        off = np.minimum(np.maximum(off, -FARTHEST_SD), FARTHEST_SD)
        square = off * off
        told = (z > 0.0) & (z < 1.0)
        sign = np.where(z > 0.0, off, -off)  # positive above full scale or under the floor
        power = np.exp(np.where(told, -0.5 * square, sign * (BOWLING[0] + BOWLING[1] * square)))
        likely = np.where(told, power / np.sqrt(2.0 * np.pi * variance), 1.0 / (1.0 + power))
        likely = (1.0 - self.outliers) * likely + self.least
        return np.asarray(np.log(quiet + (1.0 - quiet) * likely))


def normal_cdf(x: Floats) -> Floats:
    """The standard normal distribution function of x (any shape), to 1.5e-4 (Bowling et al. 2009,
    eq. 10)."""
    x = np.clip(x, -FARTHEST_SD, FARTHEST_SD)
    return np.asarray(1.0 / (1.0 + np.exp(-x * (BOWLING[0] + BOWLING[1] * x * x))))
