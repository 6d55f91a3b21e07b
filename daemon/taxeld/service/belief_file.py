"""The file that the scans a belief has learned from are kept in, over restarts.

A line of JSON, then single-precision numbers, a row a scan; at most some MB. A file that is
damaged, old or of another configuration is not used.
"""

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Floats
from taxeld.estimator.estimator import Estimator
from taxeld.estimator.history import Used
from taxeld.estimator.mixture import REMEMBERED, SILENT_MAX
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation
from taxeld.service.kept_file import FUTURE_S, KeptFile

NAME = "belief.bin"
VERSION = 1
EVERY_S, AT_LEAST_S = 60.0, 240.0  # between two writings out of contact; where nothing is new
FORGOTTEN = -1  # in place of a number of changes: the file has what counts no more
MAX_BYTES = 16_000_000  # the most scans of 5000 taxels have 8 MB
HEAD_MAX = 1000  # bytes of the line
HEAD, OF_TAXELS = 7, 8  # numbers of a scan, and of each of its taxels
NUMBER_MAX, PLACE_MAX = 2**23, 1e4  # of a contact; |x| or |y| [m], |θ| [rad]


@dataclass(frozen=True, slots=True)
class Form:
    """What a file must be of."""

    digest: str
    taxels: tuple[int, ...]  # of each link

    @classmethod
    def of(cls, estimator: Estimator) -> "Form":
        links = estimator.model.links
        made = hashlib.sha256(repr((estimator.config, estimator.robot_m)).encode())
        for known in estimator.known:
            for each in known.model.links:
                made.update(each.layout.digest.encode() + each.layout.uid.astype("<i8").tobytes())
                made.update(repr((each.depth_max_m, each.scene.symmetry)).encode())
                made.update(np.ascontiguousarray(each.scene.slices).tobytes())
                made.update(np.ascontiguousarray(each.scene.origin).tobytes())
        return cls(made.hexdigest()[:16], tuple(len(each.layout) for each in links))

    @property
    def columns(self) -> int:
        return HEAD + OF_TAXELS * max(self.taxels)


def dump(scans: Sequence[Used], t: float, form: Form) -> bytes:
    """Scans as of Unix time t."""
    rows = np.zeros((len(scans), form.columns), "<f4")
    for row, (scan, number) in zip(rows, scans, strict=True):
        noise = scan.noise or Noise(math.nan)
        row[:HEAD] = scan.link, number, scan.is_contact, *scan.sensor, noise.outliers
        own = row[HEAD:].reshape(OF_TAXELS, -1)[:, : len(scan.z)]
        of = scan.z, scan.live, scan.floor, scan.residue
        for at, values in enumerate((*of, noise.sigma, noise.gain_cv, noise.sag_m, noise.sag_sd)):
            own[at] = values
    head = {"version": VERSION, "digest": form.digest, "t": round(t, 3), "scans": len(scans)}
    return json.dumps(head).encode() + b"\n" + rows.tobytes()


def parse(data: bytes, form: Form) -> tuple[float, list[Used]]:
    """Unix time and scans, from the bytes of `dump`.

    Raises:
        ValueError: it is damaged, or of another configuration.
    """
    line, _, body = data.partition(b"\n")
    try:
        head: Any = json.loads(line) if len(line) < HEAD_MAX else None
        t, count = float(head["t"]), head["scans"]
        is_own = (head["version"], head["digest"]) == (VERSION, form.digest)
        is_whole = type(count) is int and len(body) == 4 * count * form.columns
    except (ValueError, TypeError, LookupError, OverflowError, RecursionError):
        raise ValueError("it is damaged") from None
    if not is_own:
        raise ValueError("it is of another scene, skin, configuration or version")
    if not is_whole or not math.isfinite(t) or count > REMEMBERED + SILENT_MAX:
        raise ValueError("it is damaged")
    with np.errstate(invalid="ignore"):  # of a signalling NaN
        rows = np.frombuffer(body, "<f4").astype(np.float64).reshape(count, form.columns)
    scans = [_scan(row, form) for row in rows]
    numbers = [number + (not scan.is_contact) for scan, number in scans]
    if any(b < a for a, b in pairwise(numbers)):
        raise ValueError("it is damaged")
    return t, scans


def _scan(row: Floats, form: Form) -> Used:
    link, number, contact, *sensor, outliers = row[:HEAD].tolist()
    is_fine = link in range(len(form.taxels)) and number in range(NUMBER_MAX)
    if not is_fine or not all(abs(value) <= PLACE_MAX for value in sensor):
        raise ValueError("it is damaged")
    own = row[HEAD:].reshape(OF_TAXELS, -1)[:, : form.taxels[int(link)]]
    z, live, floor, residue, sigma, gain_cv, sag_m, sag_sd = own
    noise = None
    if not np.isnan(sigma).all():
        noise = Noise(sigma, gain_cv, outliers, sag_m, sag_sd)
        low, high = own[4:].min(axis=1), own[4:].max()
        if not (low[0] > 0.0 and low.min() >= 0.0 and high < 10.0 and 0.0 < outliers < 1.0):
            raise ValueError("it is damaged")
    is_share = ((own[:4] >= 0.0) & (own[:4] <= 1.0)).all()
    if not is_share or bool(z.any()) != bool(contact):
        raise ValueError("it is damaged")
    scan = Observation(np.array(sensor), z, live > 0.0, floor, residue, noise, int(link))
    return scan, int(number)


class BeliefFile:
    """Keeps what a belief was learned from, if there is a directory to keep it in."""

    def __init__(self, place: Path | None, estimator: Estimator) -> None:
        config = estimator.config
        is_on = place is not None and config.keep_s > 0.0 and config.motion == "none"
        self._file = KeptFile(place / NAME, MAX_BYTES) if place and is_on else None
        self._keep_s, self._estimator = config.keep_s, estimator
        self._form = Form.of(estimator) if is_on else Form("", (0,))
        self._written_s, self._changes = -math.inf, 0  # without a change nothing is written

    def read(self, now: float) -> list[Used]:
        """The scans that are kept, if they can be used; `now` is Unix time."""
        found = list[Used]()

        def take(data: bytes) -> None:
            t, scans = parse(data, self._form)
            if not -FUTURE_S <= now - t <= self._keep_s:
                raise ValueError(f"it is {now - t:.0f} s old (filter.keep_s)")
            found.extend(scans)

        if self._file is not None:
            self._file.read(take, "the object is to be found again")
        return found

    def keep(self, now_s: float, wall_s: float) -> None:
        """Have the scans written if it is time to; `now_s` is monotonic. Never blocks."""
        if self._file is None or self._file.is_busy:
            return
        if self._estimator.estimate.contact and self._changes != FORGOTTEN:
            return
        changes, passed_s = self._estimator.history.changes, now_s - self._written_s
        is_due = passed_s >= (EVERY_S if changes != self._changes else AT_LEAST_S)
        if is_due and (changes or self._changes):
            self._written_s, self._changes = now_s, changes
            self._file.write(self._made(wall_s))

    def close(self, wall_s: float) -> None:
        """Write the last scans, unless the disk does not take them in time."""
        if self._file is not None:
            has_any = self._estimator.history.changes or self._changes
            self._file.close(self._made(wall_s) if has_any else None)

    def forget(self) -> None:
        """All is forgotten, which the next `keep` writes, in a contact as well."""
        self._written_s, self._changes = -math.inf, FORGOTTEN

    def _made(self, t: float) -> Callable[[], bytes]:
        """Makes the content of Unix time t."""
        return partial(dump, self._estimator.history.kept(), t, self._form)
