"""Since which contact the object has stood: the belief's target, summed over all first contacts.

Contacts belong to one pose as long as the object stands. It may have moved between two of them, so
the newest pose explains the contacts from some *first* one on, its run; the evidence of all before
it is one number (Bayesian change points, Adams & MacKay 2007). A contact may also mean nothing.
Everything is in relation to `Anything`: what the readings are worth without this object.
"""

from dataclasses import dataclass

import numpy as np

from taxeld.arrays import Bools, Floats

HAZARD = 2e-3  # probability that the object moved between two contacts
SWAPPED = float(np.log(0.1))  # log share of the moves in which another known object took its place
MEANINGLESS = 1e-3  # probability that a contact has nothing to do with the object
LEAST = float(np.log(MEANINGLESS))


@dataclass(frozen=True, slots=True)
class Runs:
    """K remembered scans in R steps: a contact, or the silence since the contact before."""

    shares: Floats  # (terms, 2 R) a scan's share in its step's contact, then in its step's silence
    usual: Floats  # (2 R,) log-likelihoods of the same without this object
    touched: Bools  # (R,) whether a step has a contact
    begun: Floats  # (R,) log prior of a run from each step on, with the evidence before it
    opens: Bools | None = None  # (R,) steps that runs may begin with; None: those with a contact
    is_known: bool = False  # whether a prior tells where the object was before the first step

    @property
    def open(self) -> Floats:
        """(R,) `begun` of the runs that poses may belong to: silence alone tells no new pose."""
        first = np.arange(len(self.begun)) == 0
        opens = self.touched if self.opens is None else self.opens
        return np.where(opens | first, self.begun, -np.inf)

    def each(self, explained: Floats) -> Floats:
        """Log-densities of poses by run: explained (N, terms) as from `Memory.explain` → (N, R)."""
        touch, silence = np.hsplit(explained @ self.shares - self.usual, 2)
        least = np.where(self.touched, LEAST, -np.inf)
        met = np.logaddexp(touch, least) + silence
        return np.asarray(met[:, ::-1].cumsum(axis=1)[:, ::-1] + self.open)

    def support(self, explained: Floats) -> Floats:
        """Log-density of poses, up to the uniform prior's: explained (N, terms) → (N,)."""
        if not len(self.begun):  # nothing is remembered but a prior, if that
            return np.asarray(explained.sum(axis=1))
        each = self.each(explained)
        top = each.max(axis=1)
        return np.asarray(top + np.log(np.exp(each - top[:, None]).sum(axis=1)))
