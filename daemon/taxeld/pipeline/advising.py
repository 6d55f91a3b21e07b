"""When advice is worked on: once the belief rests, as after a touch or a miss, and nothing else is
left to think of. Advice is of that belief alone: once it changes there is none."""

from taxeld.advice.advice import Advice, Advisor

CALM = 3  # scans in a row that tell nothing new: the sensor stands, and second opinions agree


class Advising:
    """An adviser's work, in pieces."""

    def __init__(self, advisor: Advisor | None) -> None:
        """Without an adviser there is never any work."""
        self._advisor = advisor
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
            self.advice = self._advisor.advice
