"""What is kept over restarts: what each skin has learned, and the scans of the belief."""

import time
from functools import partial

from taxeld.config.tables import Config
from taxeld.pipeline.pipeline import Pipeline
from taxeld.service import state_file
from taxeld.service.belief_file import BeliefFile
from taxeld.service.state_file import StateFile


class Restarts:
    """The files of one run."""

    def __init__(self, config: Config, pipeline: Pipeline) -> None:
        """The skins take what they learned before."""
        self._pipeline = pipeline
        self._states = [
            StateFile(
                state_file.directory(one, config.names[k] if k else ""),
                pipeline.stages[k].skin,
                partial(pipeline.skin_state, k),
            )
            for k, one in enumerate(config.each)
        ]
        for each in self._states:
            each.restore(time.time())
        self._belief: BeliefFile | None = None
        if pipeline.believing is not None:
            self._belief = BeliefFile(state_file.directory(config), pipeline.estimator)

    def restore_belief(self) -> None:
        """Have the belief learn again from what an earlier run felt."""
        if self._belief is not None:
            self._pipeline.restore(self._belief.read(time.time()))

    def keep(self, now_s: float, wall_s: float) -> None:
        """Have written what is due, at a monotonic and a Unix time. Never blocks."""
        for each in self._states:
            each.keep(now_s)
        if self._belief is not None:
            self._belief.keep(now_s, wall_s)

    def forget_belief(self) -> None:
        """All touches are forgotten."""
        if self._belief is not None:
            self._belief.forget()

    def close(self) -> None:
        """Write the last of all, unless the disk does not take it in time."""
        if self._belief is not None:
            self._belief.close(time.time())
        for each in reversed(self._states):
            each.close()
