"""Threads that run one at a time, when a fake clock lets them: the same run each time."""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any


class Threads:
    """In place of the module `threading`, for code that uses Thread, Event and a queue."""

    def __init__(self, clock: Callable[[], float], advance: Callable[[float], None]) -> None:
        """`advance` lets time pass until then, and `take_turns` meanwhile."""
        self._clock, self._advance = clock, advance
        self._all: list[_Thread] = []
        self.errors: list[BaseException] = []  # that ended a thread

    def Thread(self, **options: Any) -> "_Thread":  # noqa: N802
        made = _Thread(self, **options)
        self._all.append(made)
        return made

    def Event(self) -> "_Event":  # noqa: N802
        return _Event(self)

    def SimpleQueue(self) -> "_Queue":  # noqa: N802
        return _Queue(self)

    def park(self, due: Callable[[], bool]) -> None:
        """The calling thread rests until `due`."""
        thread = threading.current_thread()
        assert isinstance(thread, _Thread)
        thread.park(due)

    def take_turns(self) -> None:
        """Every thread that is due runs until it rests again."""
        for thread in self._all:
            thread.turn()


class _Thread(threading.Thread):
    def __init__(self, owner: Threads, **options: Any) -> None:
        super().__init__(**options)
        self._owner = owner
        self._go, self._rests = threading.Semaphore(0), threading.Semaphore(0)
        self._due: Callable[[], bool] = lambda: True
        self._is_over = False

    def run(self) -> None:
        self._go.acquire()
        try:
            super().run()
        except BaseException as error:
            self._owner.errors.append(error)
        self._is_over = True
        self._rests.release()

    def park(self, due: Callable[[], bool]) -> None:
        self._due = due
        self._rests.release()
        self._go.acquire()

    def turn(self) -> None:
        if self.ident is not None and not self._is_over and self._due():
            self._go.release()
            self._rests.acquire()

    def is_alive(self) -> bool:
        return self.ident is not None and not self._is_over

    def join(self, timeout: float | None = None) -> None:
        until_s = self._owner._clock() + (60.0 if timeout is None else timeout)
        while self.is_alive() and self._owner._clock() < until_s:
            self.turn()
            self._owner._advance(self._owner._clock() + 0.01)


class _Event:
    def __init__(self, owner: Threads) -> None:
        self._owner, self._is_set = owner, False

    def set(self) -> None:
        self._is_set = True

    def clear(self) -> None:
        self._is_set = False

    def is_set(self) -> bool:
        return self._is_set

    def wait(self, timeout: float = 1e9) -> bool:
        until_s = self._owner._clock() + timeout
        self._owner.park(lambda: self._is_set or self._owner._clock() >= until_s)
        return self._is_set


class _Queue(deque[Any]):
    def __init__(self, owner: Threads) -> None:
        super().__init__()
        self._owner, self.put = owner, self.append

    def get(self) -> Any:
        self._owner.park(lambda: bool(self))
        return self.popleft()
