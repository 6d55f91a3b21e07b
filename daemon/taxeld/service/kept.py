"""What is kept over restarts: what each skin has learned, and the scans of the belief. They are in
one file of numpy's, without pickle.

Who writes the file holds a lock on its directory, and has learned what was in it. Digests say whose
both are; the zip's checksums say whether the file is whole. What is old, damaged or of another
configuration is not used, and what cannot be learned is set aside. A worker, which starts before
the loop takes its priority, writes the file, and packs the belief's scans for clients.
"""

import contextlib
import errno
import fcntl
import io
import logging
import math
import os
import zipfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
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
from taxeld.service.surroundings import MACHINE, Surroundings
from taxeld.skin.calibration import SkinState
from taxeld.skin.skin import Skin
from taxeld.stream.link import Link
from taxeld.worker import Job

NAME, ASIDE = "kept.npz", "failed.npz"
MEMORY = "the scans for clients"
EVERY_S, AT_LEAST_S = 60.0, 240.0  # between two writings out of contact; where nothing is new
AGAIN_S = 1.0  # until a writing that failed is tried again
BASELINE_S = 43_200.0  # an idle baseline that was stored longer ago is not used
KEEP_S = 600.0  # what was felt is used by a start that comes so soon
MEMORY_S = 1.0  # between two handings-over of what was felt
CLOSE_S = 4.0  # time that the last two jobs of the worker may take
TAKEN = (
    "another daemon keeps its state there; nothing is kept of this one: give each a skin.state_dir"
)

Arrays = dict[str, NDArray[Any]]
log = logging.getLogger(__name__)


class Store:
    """The skins and the belief of one run, and their file, if there is a directory to keep it
    in."""

    def __init__(self, config: Config, pipeline: Pipeline, around: Surroundings = MACHINE) -> None:
        """Nothing is read or written before `restore`."""
        self.failed = 0  # times that the file, or the scans for clients, could not be written
        self._place, self._pipeline = directory(config), pipeline
        self._path: Path | None = None  # the file, while the directory is this run's
        self._lock = -1  # the directory, open and locked
        self._found: Arrays = {}  # what was stored of the skins
        self._estimator = pipeline.estimator if pipeline.has_object else None
        is_kept = pipeline.has_object and config.filter.motion == "none"
        self._keep_s = KEEP_S if is_kept else 0.0
        self._written_s, self._captures = -math.inf, 0
        self._scans: Sequence[ScanEvidence] = ()  # that were written last
        self._asked = self._forgot = 0  # resets and tares: all, and those that the disk has
        self._faults: dict[Path | str, str] = {}  # of what is written
        self._packed: BinaryIO | None = None  # scans for clients, until the door has them
        self._handed: tuple[object, ...] = ()  # what was packed last, and for which door
        self._next_memory_s = -math.inf
        self._unix, self._worker = around.unix, around.worker("kept")

    @property
    def pending(self) -> int:
        """Number of resets and tares that a restart would undo."""
        return self._asked - self._forgot if self._path else 0

    def restore(self) -> None:
        """Have skins and belief learn what an earlier run has left; from now on the directory is
        this run's, unless it is another's."""
        if self._place is None:
            return
        try:
            self._place.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(self._place, os.O_RDONLY)
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self.failed += 1
            why = error.strerror or str(error)
            _warn(self._place, TAKEN if error.errno == errno.EWOULDBLOCK else why)
            return
        self._path = path = self._place / NAME
        try:
            found = read(path)
            for k, stage in enumerate(self._pipeline.stages):
                if stored := _part(f"skin{k}.", found):
                    self._restore(stored, stage.skin)
            self._found = {name: found[name] for name in found if name.startswith("skin")}
            if self._keep_s and not self._asked and (stored := _part("belief.", found)):
                self._restore_belief(stored)
        except Exception as error:  # each start would die of it
            self._pipeline.reset()
            with contextlib.suppress(OSError):
                path.replace(path.with_name(ASIDE))
            log.error("%s: set aside as %s: it cannot be learned (%r)", path, ASIDE, error)

    def _restore(self, stored: Arrays, skin: Skin) -> None:
        """The taxels' responses last longer than the baseline."""
        values = {name: value if value.ndim else value.item() for name, value in stored.items()}
        state = SkinState(**values)  # type: ignore[arg-type]
        if state.digest != skin.digest:
            _warn(self._path, "it is of another skin: the idle baseline is learned again")
            return
        age_s = self._unix() - state.t
        is_fresh = abs(age_s) <= BASELINE_S  # a clock may be set back
        skin.restore(state, baseline=is_fresh)
        if not is_fresh:
            _warn(
                self._path, f"it is {age_s / 3600.0:.1f} h old: the idle baseline is learned again"
            )

    def _restore_belief(self, stored: Arrays) -> None:
        """Have the belief learn again from what an earlier run felt."""
        estimator, age_s = self._pipeline.estimator, self._unix() - stored["t"].item()
        why = f"it is {age_s:.0f} s old" if abs(age_s) > self._keep_s else ""
        if stored["digest"].item() != estimator.digest:
            why = "it is of another scene, skin or configuration"
        if why:
            _warn(self._path, f"{why}: the object is to be found again")
        else:
            estimator.learn(scans_of(stored), moved=True)

    def keep(self, now_s: float, wall_s: float) -> None:
        """Have all written if it is time to, at a monotonic and a Unix time. Never blocks."""
        if self._path is None or self._worker.behind:
            return
        scans = self._estimator.scans if self._estimator else ()
        captures = sum(stage.skin.captures for stage in self._pipeline.stages)
        usual_s = EVERY_S if scans != self._scans else AT_LEAST_S
        wait_s = AGAIN_S if self._faults.get(self._path) else usual_s
        is_due = captures != self._captures or now_s >= self._written_s + wait_s
        is_calm = bool(captures or scans) and not self._pipeline.is_touched
        if is_due and (is_calm or self.pending):
            self._written_s, self._scans, self._captures = now_s, scans, captures
            self._give_all(self._path, wall_s)

    def forget(self, *, baselines: bool = False) -> None:
        """All touches are forgotten, or else all `baselines`: the next `keep` writes that, during a
        contact as well, and it is pending until the disk has it."""
        for name in (name for name in self._found if baselines and name.endswith(".baseline")):
            self._found[name] = np.full_like(self._found[name], np.nan)
        self._asked, self._written_s = self._asked + 1, -math.inf

    def remember(self, link: Link, now_s: float) -> None:
        """Hand the doors the scans that the belief has learned from, for clients that learn them as
        well: once there are others, or another door, or one that has missed something. Never
        blocks."""
        if self._worker.behind:
            return
        packed, self._packed = self._packed, None
        if packed is not None:
            with contextlib.suppress(OSError), packed:
                link.remember(packed.fileno())
        if self._estimator is None or not link.is_ready or now_s < self._next_memory_s:
            return
        felt = link.ready, link.counts["unsent"], self._estimator.scans
        is_known = felt == self._handed and not self._faults.get(MEMORY)
        if not (is_known or self._pipeline.is_touched):
            self._handed, self._next_memory_s = felt, now_s + MEMORY_S
            packs = partial(self._pack, self._estimator.scans, self._estimator.digest)
            self._worker.give(partial(self._do, MEMORY, packs))

    def close(self) -> None:
        """Write the last of all, unless the disk does not take it in time."""
        if self._path is not None:
            self._give_all(self._path, self._unix())
        if self._worker.close(CLOSE_S) and self._lock >= 0:
            os.close(self._lock)
            self._lock = -1
        if self._packed is not None:
            self._packed.close()

    def _do(self, what: Path | str, job: Job) -> None:
        """Do what may fail. A fault is counted, and logged when it changes."""
        fault = ""
        try:
            job()
        except Exception as error:  # a disk that takes nothing; a fault of ours ends nothing else
            self.failed += 1
            fault = f"not written ({getattr(error, 'strerror', None) or repr(error)})"
        if fault != self._faults.get(what, ""):
            log.warning("%s: %s", what, fault or "written again")
        self._faults[what] = fault

    def _give_all(self, path: Path, t: float) -> None:
        """Have all written as of Unix time t; what is taken along changes no more. A skin that is
        not ready yet keeps what was stored of it. Nothing is written before there is something to
        keep, or to forget."""
        by, estimator, asked = self._pipeline.stepped_s, self._estimator, self._asked
        states = [stage.skin.state() for stage in self._pipeline.stages]
        scans = until_last_touch(estimator.scans) if estimator and self._keep_s else []
        digest = np.array(estimator.digest if scans and estimator else "")

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
            if not found and asked == self._forgot:
                return
            try:
                _replace(path, found | {"version": np.array(VERSION)})
            except OSError:
                if asked != self._forgot:  # it is not to come back, and this needs no room
                    path.unlink(missing_ok=True)
                    self._forgot = asked
                raise
            finally:
                os.fsync(self._lock)
            self._forgot = asked

        self._worker.give(partial(self._do, path, write))

    def _pack(self, scans: Sequence[ScanEvidence], digest: str) -> None:
        packed = os.fdopen(os.memfd_create("memory"), "w+b")
        np.savez(packed, allow_pickle=False, **scan_arrays(scans), digest=np.array(digest))
        packed.flush()
        self._packed = packed


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
    beside.unlink(missing_ok=True)
    with beside.open("xb") as file:
        np.savez(file, allow_pickle=False, **arrays)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def _part(prefix: str, arrays: Arrays) -> Arrays:
    return {name[len(prefix) :]: arrays[name] for name in arrays if name.startswith(prefix)}
