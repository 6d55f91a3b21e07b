"""When advice is worked on: once the belief rests, as after a touch or a miss, and nothing else is
left to think of. Advice is of that belief alone: once it changes there is none; and as long as it
does not, an approach that was tried is not named again."""

from collections.abc import Sequence
from dataclasses import replace

from taxeld.advice.advice import Advice, Advisor, Approach
from taxeld.arrays import Poses
from taxeld.model import se2

CALM = 3  # scans in a row that tell nothing new: the sensor stands, and second opinions agree
MOST = 3  # approaches of an advice


class Advising:
    """An adviser's work, in pieces."""

    def __init__(self, advisor: Advisor | None, mounts: Sequence[Poses | None] = ()) -> None:
        """Without an adviser there is never any work. `mounts`: each link's sensor frame (3,) in
        the frame of the robot's poses, as which approaches are told; None: they are the same."""
        self._advisor, self._mounts = advisor, mounts
        self.changed()

    def changed(self) -> None:
        """The belief is another one."""
        self.advice: Advice | None = None  # on the present belief
        self._left: list[Approach] = []  # that were not tried since, in sensors' poses
        self._calm, self._is_begun = 0, False

    def on_scan(self, sensor: Poses, link: int, *, told: bool, moves: bool) -> None:
        """A scan of a link has been taken at its sensor's pose (3,); `told`: of a touch, or it has
        changed the belief; `moves`: the sensor is at another place."""
        if told:
            self.changed()
        self._calm = 0 if moves else self._calm + (not told)
        left = [one for one in self._left if not one.is_at(sensor, link)]
        if len(left) < len(self._left):
            self._say(left)

    @property
    def has_work(self) -> bool:
        """Whether `step` has something to do."""
        return self._advisor is not None and self.advice is None and self._calm >= CALM

    def step(self) -> None:
        """Do a piece of work, if there is any."""
        if self._advisor is None or not self.has_work:
            return
        if not self._is_begun:
            self._advisor.begin()
            self._is_begun = True
        if self._advisor.step():
            made = self._advisor.advice
            assert made is not None  # noqa: S101  (there is new advice)
            self.advice = made
            self._say(list(made.approaches))

    def _say(self, left: list[Approach]) -> None:
        """Advise the best of those that are left."""
        assert self.advice is not None  # noqa: S101  (nothing is left before)
        best = tuple(map(self._as_robot, left[:MOST]))
        self._left, self.advice = left, replace(self.advice, approaches=best)

    def _as_robot(self, one: Approach) -> Approach:
        """An approach in the poses that the robot sends."""
        mount = self._mounts[one.link]
        if mount is None:
            return one
        back = se2.inverse(mount)
        before, at, until = (se2.compose(p, back) for p in (one.before, one.at, one.until))
        return replace(one, before=before, at=at, until=until)
