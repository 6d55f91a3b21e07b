"""When advice is worked on: once the belief rests, as after a touch or a miss, and nothing else is
left to think of. Advice is of that belief alone: once it changes there is none."""

from collections.abc import Sequence
from dataclasses import replace

from taxeld.advice.advice import Advice, Advisor, Approach
from taxeld.arrays import Poses
from taxeld.model import se2

CALM = 3  # scans in a row that tell nothing new: the sensor stands, and second opinions agree


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
        self._calm, self._is_begun = 0, False

    def on_scan(self, *, told: bool) -> None:
        """A scan has been taken; `told`: of a touch, or it has changed the belief."""
        if told:
            self.changed()
        self._calm += not told

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
            self.advice = replace(made, approaches=tuple(map(self._as_robot, made.approaches)))

    def _as_robot(self, one: Approach) -> Approach:
        """An approach in the poses that the robot sends."""
        mount = self._mounts[one.link]
        if mount is None:
            return one
        back = se2.inverse(mount)
        before, at, until = (se2.compose(p, back) for p in (one.before, one.at, one.until))
        return replace(one, before=before, at=at, until=until)
