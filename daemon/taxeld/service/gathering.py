"""When to read a device that has begun to send.

A pass for each frame of a scan would cost more than the work on the scan. So frames gather, and the
pass comes with a scan's last frame. Earlier scans have shown how many frames there are and how far
apart; the device is not waited on before the rest can have arrived.
"""

import time
from collections.abc import Callable
from typing import Protocol

from taxeld.service.inputs import Ready

REST_S = (0.0005, 0.004)  # first and longest rest while the time of further frames is unknown
LEAST_S = 0.0002  # shortest rest that pays
LATE_S = 0.001  # delay allowed to the rest of a scan: adapters may send once a millisecond
MORE = 0.25  # share of a scan's growth over the last ones that is expected of the next
LONGER, SHORTER = 1.05, 0.98  # factors on the pace; with them two of seven scans are read early


class Waits(Protocol):
    """The part of `inputs.Inputs` used here."""

    def wait(self, until_s: float) -> Ready: ...

    def rest(self, until_s: float) -> Ready: ...


class Gathering:
    """Follows one device. Sizes are in frames or bytes, as the device counts."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._whole = 0.0  # size of a scan
        self._each_s = 0.0  # time from one frame or byte to the next
        self._had = 0  # size of this scan's part that early passes have taken
        self._held = 0  # size of the part that no pass has taken
        self._first: tuple[float, int] | None = None  # the scan's time and size when first seen
        self._was_early = False  # whether the scan was late, and still not whole when read
        self._looks = 0  # passes on this scan that were too early

    @property
    def has_begun(self) -> bool:
        """Whether something has arrived that no pass has taken."""
        return self._held > 0

    def heard(self, held: int) -> float:
        """Take the size `held` of the arrivals that no pass has taken; → the time [s] before which
        the rest of the scan cannot be there; 0: the scan may be whole."""
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
        """Wait until a scan may be whole, frames stop, or another input is ready; the device is
        then to be read. `hear` keeps the arrivals and returns their size."""
        rest_s, held = self.heard(hear()), 0
        while rest_s and held < self._held:
            held = self._held
            ready = waits.rest(min(until_s, self._clock() + rest_s))
            if not ready.robot:
                ready = waits.wait(min(until_s, self._clock() + LATE_S))
            if ready.robot:
                return ready._replace(device=True)
            rest_s = self.heard(hear())
        return Ready(device=True)

    def looked(self, scans: int) -> float:
        """A pass has taken the arrivals: `scans` whole scans, or 0; → the time [s] for which the
        device is then left alone."""
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
        """Update the pace: `come` arrived within `took_s` after the scan was first seen. For a scan
        that was whole when read, this is only an upper bound of the time."""
        if come > 0:
            step = LONGER if self._was_early else SHORTER
            self._each_s = min(took_s / come, self._each_s * step or took_s / come)
