"""The scans that were learned from, so that another estimator can learn from them again."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from taxeld.estimator.mixture import REMEMBERED, SILENT_MAX
from taxeld.model.observation import Observation

MOVED = 0.05  # probability that the object was moved while no daemon ran

Used = tuple[Observation, int]
"""A scan that was learned from, and the number of its contact or of the one before."""


@dataclass(slots=True)
class History:
    """As many scans as a memory has."""

    scans: Sequence[Used] = ()
    changes: int = field(default=0)

    def add(self, observation: Observation, number: int) -> None:
        """Of too many scans of its kind the oldest goes, of the contact with the most scans."""
        self.changes += 1
        scans = [*self.scans, (observation, number)]
        of = [i for i, (scan, _) in enumerate(scans) if scan.is_contact == observation.is_contact]
        if len(of) > (REMEMBERED if observation.is_contact else SILENT_MAX):
            numbers = [scans[i][1] for i in of]
            most = max(map(numbers.count, numbers)) if observation.is_contact else 0
            del scans[next(i for i in of if numbers.count(scans[i][1]) >= most)]
        self.scans = scans

    def kept(self) -> list[Used]:
        """Without the silence after the last contact: the object may be moved before the next."""
        last = max((number for scan, number in self.scans if scan.is_contact), default=0)
        return [used for used in self.scans if used[1] < last or used[0].is_contact]
