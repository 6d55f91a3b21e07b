"""A thread for what its giver may not wait for: a disk that is slow, a reader that hangs."""

import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue

Job = Callable[[], object]


class Worker:
    """Does jobs one after another, until it is closed; each sees to its own faults."""

    def __init__(self, name: str, turn: Job = lambda: None, every_s: float | None = None) -> None:
        """`turn` is done each time that no job has been given for `every_s`."""
        self._jobs: SimpleQueue[Job | None] = SimpleQueue()
        self._given = self._done = 0
        self._turn, self._every_s = turn, every_s
        # what hangs must not keep the process from ending
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def behind(self) -> int:
        """Number of jobs that are not done yet."""
        return self._given - self._done

    def give(self, job: Job) -> None:
        """Have a job done after those before it. Never waits; to be called by one thread at a
        time."""
        self._given += 1
        self._jobs.put(job)

    def close(self, most_s: float) -> bool:
        """End after the jobs given so far, if they take `most_s` at most; → whether they did."""
        self._jobs.put(None)
        self._thread.join(most_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            try:
                job = self._jobs.get(timeout=self._every_s)
            except Empty:
                self._turn()
                continue
            if job is None:
                return
            job()
            self._done += 1
