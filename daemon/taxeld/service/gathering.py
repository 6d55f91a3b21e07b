"""When to look at a device that has begun to speak.

A pass for each frame of a scan would cost more than all that it takes. Frames are left to gather,
and the pass comes with a scan's last one. How many there are, and how far apart, the scans before
have shown; meanwhile the device is not listened to for as long as the rest cannot be there.
"""

import time
from collections.abc import Callable
from typing import Protocol

from taxeld.service.inputs import Ready

REST_S = (0.0005, 0.004)  # for more that may come at any time: at first, and at most
LEAST_S = 0.0002  # a shorter rest does not pay
LATE_S = 0.001  # that the rest of a scan may be late, as where an adapter speaks once a millisecond
MORE = 0.25  # of what a scan brought beyond the ones before: taken to be of the next as well
LONGER, SHORTER = 1.05, 0.98  # by which the pace is followed: two of seven scans are heard early


class Waits(Protocol):
    """`inputs.Inputs`, as far as this goes."""

    def wait(self, until_s: float) -> Ready: ...

    def rest(self, until_s: float) -> Ready: ...


class Gathering:
    """Follows one device. Sizes are of what it counts by: frames, or bytes."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._whole = 0.0  # size of a scan
        self._each_s = 0.0  # from one to the next
        self._had = 0  # of this scan, in passes that were too early
        self._held = 0  # more of it, that no pass has seen
        self._first: tuple[float, int] | None = None  # when it was seen to begin, and how much
        self._was_early = False  # whether it was heard after its time, and was not whole
        self._looks = 0  # at this scan, in vain

    @property
    def has_begun(self) -> bool:
        """Whether something is there that no pass has seen."""
        return self._held > 0

    def heard(self, held: int) -> float:
        """So much is there now that no pass has seen; → for how long the rest of the scan cannot
        be; 0: it may be whole."""
        now_s = self._clock()
        self._held, come = held, self._had + held
        if self._first is None:
            self._first = now_s, come
        began_s, had = self._first
        if come > self._whole - 1.0:
            self._measure(now_s - began_s, come - had)
            return 0.0
        left_s = began_s + (self._whole - had) * self._each_s - now_s
        self._was_early |= left_s <= 0.0
        return min(max(left_s, LEAST_S), REST_S[1])

    def gather(self, waits: Waits, hear: Callable[[], int], until_s: float) -> Ready:
        """Until a scan may be whole, nothing more comes, or others do; `hear` takes what there is,
        → how much that is by now. The device is to be looked at then."""
        rest_s, held = self.heard(hear()), 0
        while rest_s and held < self._held:
            held = self._held
            ready = waits.rest(min(until_s, self._clock() + rest_s))
            if not (ready.robot or ready.peers):
                ready = waits.wait(min(until_s, self._clock() + LATE_S))
            if ready.robot or ready.peers:
                return ready._replace(device=True)
            rest_s = self.heard(hear())
        return Ready(device=True)

    def looked(self, scans: int) -> float:
        """A pass has taken what was there: so many scans, or too little for one; → for how long the
        device is left alone then."""
        come, self._held = self._had + self._held, 0
        if scans:
            size = come / scans
            more = size - self._whole if self._whole else 0.0
            self._whole = size if more <= 0.0 else self._whole + MORE * more
            self._had, self._first, self._was_early, self._looks = 0, None, False, 0
            return 0.0
        self._had = come
        if not come or come < self._whole:
            return 0.0
        self._looks += 1
        least_s, most_s = REST_S
        return min(least_s * 2.0 ** min(self._looks - 1, 9), most_s)

    def _measure(self, took_s: float, come: int) -> None:
        """The pace, as so much has come since the first of a scan was seen. Of one that was whole
        when it was looked for, it shows only that it is no slower."""
        if come > 0:
            step = LONGER if self._was_early else SHORTER
            self._each_s = min(took_s / come, self._each_s * step or took_s / come)
