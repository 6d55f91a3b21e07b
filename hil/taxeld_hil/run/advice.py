"""Advice for a robot in real time: asked of the daemon beside the run, as `taxeld advise` does."""

import threading
import time
from pathlib import Path

from taxeld.advice.advice import Advice
from taxeld.commands.advise import Adviser, remembered
from taxeld.config.file import load
from taxeld.errors import SetupError
from taxeld.service.kept import MEMORY_S
from taxeld_hil.scenario.settings import REACH

PAUSE_S = 0.1  # between two questions
REST_S = MEMORY_S + 0.5  # after which the daemon has handed over the last touch


class AdviceThread:
    """Asks once at a time; the run goes on meanwhile."""

    def __init__(self, config: Path) -> None:
        made = load(config)
        self._endpoint, self._adviser = made.control.endpoint, Adviser(made, REACH)
        self._thread: threading.Thread | None = None
        self._found: Advice | None = None

    def ask(self) -> None:
        """Want advice on all that the daemon has handed over by now."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, daemon=True)
            self._thread.start()

    def taken(self) -> Advice | None:
        """The advice that was asked for, once."""
        found, self._found = self._found, None
        if found is not None:
            self._thread = None
        return found

    def _run(self) -> None:
        while self._found is None:
            try:
                self._found = self._adviser.advise(remembered(self._endpoint))
            except SetupError:  # it has felt nothing yet, or ends
                time.sleep(PAUSE_S)
