"""What all runs have in common: each leaves a session, which is then graded."""

import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from taxeld.arrays import Poses
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld_hil.grade.grade import Grade, grade
from taxeld_hil.grade.session import PUBLISHED, Run
from taxeld_hil.rig.rig import Rig
from taxeld_hil.scenario.scenario import Scenario


class SessionRun(ABC):
    """A scenario around a daemon."""

    scenario: Scenario
    clock: str  # fake, real
    seed = 0
    rigs: Sequence[Rig]  # of each link
    not_injected: Sequence[str] = ()  # kinds of faults that are not possible
    growth_mb = 0.0  # of the daemon's memory
    end_s = 0.0  # scenario time at the end
    published: BinaryIO | None = None  # while it is played

    def graded(self, name: str, directory: Path | None = None) -> Grade:
        """Play the scenario of this name to its end, leave its session in `directory`, and grade
        it; without a directory the session is thrown away.

        Raises:
            SetupError: the directory has a session, or a process failed.
        """
        with tempfile.TemporaryDirectory(prefix="taxeld-") as made:
            place = Path(made)
            directory = directory or place / "session"
            directory.mkdir(parents=True, exist_ok=True)
            path = directory / session.CONFIG
            try:
                with path.open("x", encoding="utf-8") as file:
                    file.write(self._config(place))
            except FileExistsError:
                line = f"--out: {path} is there already; name another directory"
                raise SetupError(line) from None
            with (directory / PUBLISHED).open("wb") as self.published:
                self._play(directory, place)
            self.published = None
            self._about(name).write(directory)
            graded = grade(directory)
            graded.write(directory)
            return graded

    @abstractmethod
    def _config(self, place: Path) -> str:
        """The daemon's configuration; its sockets are in `place`."""

    @abstractmethod
    def _play(self, directory: Path, place: Path) -> None:
        """To the end, with a daemon of that configuration; what skin and robot send goes into the
        directory."""

    def _about(self, name: str) -> Run:
        first, *others = (rig.ledger for rig in self.rigs)
        taxels = [self.rigs[fault.link].taxels_of(fault) for fault in self.scenario.fault]
        about = name, self.seed, self.clock, self.scenario, self.end_s, taxels
        return Run(*about, self.not_injected, first.entries(*others), self.growth_mb)


def write_truth(directory: Path, truth: Poses) -> None:
    """Write truth.csv of a session; it is complete as soon as it exists."""
    row = ",".join(f"{v:.6f}" for v in (time.time(), *truth))
    directory.mkdir(parents=True, exist_ok=True)  # a recorder makes it with its first record
    partial = directory / f"{session.TRUTH}.partial"
    partial.write_text(f"t,x,y,theta\n{row}\n", encoding="ascii")
    partial.rename(directory / session.TRUTH)
