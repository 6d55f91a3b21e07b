"""What is kept over restarts: what each skin has learned, and the scans of the belief. They are in
one file of numpy's, without pickle.

Digests say whose both are; the zip's checksums say whether the file is whole. What is old, damaged
or of another configuration is not used. One thread, which starts before the loop takes its
priority, writes the file, and packs the belief's scans for clients.
"""

import io
import logging
import math
import os
import threading
import time
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from taxeld import files
from taxeld.config.tables import Config
from taxeld.estimator.scans import (
    VERSION,
    ScanEvidence,
    scan_arrays,
    scans_of,
    until_last_touch,
)
from taxeld.pipeline.pipeline import Pipeline
from taxeld.pipeline.stage import later
from taxeld.skin.calibration import SkinState
from taxeld.skin.skin import Skin
from taxeld.stream.link import Link

NAME = "kept.npz"
EVERY_S, AT_LEAST_S = 60.0, 240.0  # between two writings out of contact; where nothing is new
BASELINE_S = 43_200.0  # an idle baseline that was stored longer ago is not used
KEEP_S = 600.0  # what was felt is used by a start that comes so soon
FUTURE_S = 3600.0  # a time farther ahead was stored by a wrong clock, or is read by one
MEMORY_S, SILENT_S = 1.0, 5.0  # between two handings-over of what was felt; of silence alone
CLOSE_S = 4.0  # time that the last two jobs of the thread may take

Arrays = dict[str, NDArray[Any]]
Job = Callable[[], None]
log = logging.getLogger(__name__)


class Writer:
    """A thread that does what the loop may not wait for, one job after another."""

    def __init__(self, what: str) -> None:
        """`what` the jobs write, for the log."""
        self._what = what
        self._next: Job | None = None  # until it is done
        self._last: Job | None = None
        self._failed = False
        self._wake = threading.Event()
        # a disk that hangs must not keep the daemon from ending
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """Whether the job is not done yet."""
        return self._next is not None

    def give(self, job: Job) -> None:
        """Have a job done, by a thread that is not busy."""
        self._next = job
        self._wake.set()

    def close(self, job: Job) -> None:
        """Have a last job done, unless the disk does not take it in time."""
        self._last = job
        self._wake.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while self._last is None:
            self._wake.wait()
            self._wake.clear()
            if self._next is not None:
                self._do(self._next)
                self._next = None
        self._do(self._last)

    def _do(self, job: Job) -> None:
        try:
            job()
        except Exception as error:  # a disk that takes nothing; a fault of ours ends nothing else
            if not self._failed:
                why = getattr(error, "strerror", None) or repr(error)
                log.warning("%s: not written (%s)", self._what, why)
            self._failed = True


class Store:
    """The skins and the belief of one run, and their file, if there is a directory to keep it
    in."""

    def __init__(self, config: Config, pipeline: Pipeline) -> None:
        """The skins take what they learned before."""
        place, self._pipeline = directory(config), pipeline
        self._path = None if place is None else place / NAME
        self._found: Arrays = {} if self._path is None else read(self._path)
        self._estimator = pipeline.estimator if pipeline.has_object else None
        self._keep_s = KEEP_S if config.filter.motion == "none" else 0.0
        self._written_s, self._captures = -math.inf, 0
        self._scans: Sequence[ScanEvidence] = ()  # that were written last
        self._is_forgotten = False
        self._packed: BinaryIO | None = None  # scans for clients, until the door has them
        self._handed: tuple[object, ...] = ()  # what was packed last, and for which door
        self._touches: Sequence[ScanEvidence] = ()  # the contacts in it
        self._handed_s = self._next_memory_s = -math.inf
        self._writer = Writer(str(self._path or NAME))
        for k, stage in enumerate(pipeline.stages):
            self._restore(_part(f"skin{k}.", self._found), stage.skin)

    def _restore(self, stored: Arrays, skin: Skin) -> None:
        """The taxels' responses last longer than the baseline."""
        if not stored:
            return
        values = {name: value if value.ndim else value.item() for name, value in stored.items()}
        state = SkinState(**values)  # type: ignore[arg-type]
        if state.digest != skin.digest:
            _warn(self._path, "it is of another skin: the idle baseline is learned again")
            return
        age_s = time.time() - state.t
        is_fresh = -FUTURE_S <= age_s <= BASELINE_S
        skin.restore(state, baseline=is_fresh)
        if not is_fresh:
            _warn(
                self._path, f"it is {age_s / 3600.0:.1f} h old: the idle baseline is learned again"
            )

    def restore_belief(self) -> None:
        """Have the belief learn again from what an earlier run felt."""
        stored = _part("belief.", self._found)
        self._found = {name: self._found[name] for name in self._found if name.startswith("skin")}
        if not stored or not self._keep_s:
            return
        age_s = time.time() - stored["t"].item()
        if stored["digest"].item() != self._pipeline.estimator.digest:
            why = "it is of another scene, skin or configuration"
        elif not -FUTURE_S <= age_s <= self._keep_s:
            why = f"it is {age_s:.0f} s old"
        else:
            self._pipeline.estimator.learn(scans_of(stored), moved=True)
            return
        _warn(self._path, f"{why}: the object is to be found again")

    def keep(self, now_s: float, wall_s: float) -> None:
        """Have all written if it is time to, at a monotonic and a Unix time. Never blocks."""
        if self._path is None or self._writer.is_busy:
            return
        scans = self._estimator.scans if self._estimator else ()
        captures = sum(stage.skin.captures for stage in self._pipeline.stages)
        wait_s = EVERY_S if scans != self._scans else AT_LEAST_S
        is_due = captures != self._captures or now_s >= self._written_s + wait_s
        is_due = is_due and bool(captures or scans) and not self._pipeline.is_touched
        if is_due or self._is_forgotten:
            self._written_s, self._scans, self._captures = now_s, scans, captures
            self._is_forgotten = False
            self._writer.give(self._writing(self._path, wall_s))

    def forget_belief(self) -> None:
        """All touches are forgotten, which the next `keep` writes, during a contact as well."""
        self._is_forgotten = True

    def remember(self, link: Link, now_s: float) -> None:
        """Hand the door the scans that the belief has learned from, for clients that learn them as
        well: once there are others, or another door. Never blocks."""
        if self._packed is not None:
            with self._packed as packed:
                link.remember(packed.fileno())
            self._packed = None
        if self._estimator is None or not link.is_ready or now_s < self._next_memory_s:
            return
        scans = self._estimator.scans
        key = link.ready, scans
        if key == self._handed or self._pipeline.is_touched or self._writer.is_busy:
            return
        touches = [scan for scan in scans if scan.is_contact]
        is_same = self._handed[:1] == key[:1] and touches == self._touches
        self._next_memory_s = now_s + MEMORY_S
        if is_same and now_s < self._handed_s + SILENT_S:
            return
        self._handed, self._touches, self._handed_s = key, touches, now_s
        digest = np.array(self._estimator.digest)

        def pack() -> None:
            packed = os.fdopen(os.memfd_create("memory"), "w+b")
            np.savez(packed, allow_pickle=False, **scan_arrays(scans), digest=digest)
            packed.flush()
            self._packed = packed

        self._writer.give(pack)

    def close(self) -> None:
        """Write the last of all, unless the disk does not take it in time."""
        if self._path is not None:
            self._writer.close(self._writing(self._path, time.time()))
        else:
            self._writer.close(lambda: None)
        if self._packed is not None:
            self._packed.close()

    def _writing(self, path: Path, t: float) -> Job:
        """The job of writing the content of Unix time t, of what does not change any more. A skin
        that is not ready yet keeps what was stored of it. Nothing is written before there is
        something to keep, or to forget."""
        by, estimator = self._pipeline.stepped_s, self._estimator
        states = [stage.skin.state() for stage in self._pipeline.stages]
        scans = until_last_touch(estimator.scans) if estimator and self._keep_s else []
        digest = np.array(estimator.digest if scans and estimator else "")
        was_written = self._written_s > -math.inf or self._is_forgotten

        def write() -> None:
            found: Arrays = {}
            for k, state in enumerate(states):
                values = _part(f"skin{k}.", self._found)
                if state is not None:
                    values = asdict(later(state, by))
                found |= {f"skin{k}.{name}": np.asarray(value) for name, value in values.items()}
            if scans:
                belief = scan_arrays(scans) | {"t": np.array(t), "digest": digest}
                found |= {f"belief.{name}": value for name, value in belief.items()}
            if found or was_written:
                _replace(path, found | {"version": np.array(VERSION)})

        return write


def directory(config: Config) -> Path | None:
    """Where the file is; None: nowhere."""
    name = config.skin.state_dir or os.environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(name) if name else None


def read(path: Path) -> Arrays:
    """The content of a file; {} where there is none, or none that can be used, which is warned
    of."""
    try:
        data = io.BytesIO(files.read(path))
        with zipfile.ZipFile(data) as whole:
            # its end says how many arrays there are: a damaged list of them seems shorter
            number = int.from_bytes(data.getvalue()[-12:-10], "little")
            if whole.testzip() is not None or len(whole.namelist()) != number:
                raise ValueError
        data.seek(0)
        with np.load(data, allow_pickle=False) as arrays:
            found = dict(arrays)
    except FileNotFoundError:
        return {}
    except OSError as error:
        _warn(path, error.strerror or str(error))
    except Exception:  # exceptions of zip, zlib and numpy's headers share no base
        _warn(path, "it is damaged")
    else:
        if found.get("version") == VERSION:
            return found
        _warn(path, "it is of another version: skin and object are learned again")
    return {}


def _warn(path: Path | None, reason: str) -> None:
    log.warning("%s: not used, %s", path, reason)


def _replace(path: Path, arrays: Arrays) -> None:
    """Write arrays in place of a file, or of a link, which is not followed. A power cut leaves the
    old file or the new one. Raises OSError."""
    beside = path.with_suffix(".new")
    path.parent.mkdir(parents=True, exist_ok=True)
    beside.unlink(missing_ok=True)
    with beside.open("xb") as file:
        np.savez(file, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def _part(prefix: str, arrays: Arrays) -> Arrays:
    return {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}
