"""`/taxeld/health` as an OpenMetrics text file, for node_exporter's textfile collector.

Written once a second by a thread of its own: beside, and then renamed, so that a reader has the old
one or the new one, whole.
"""

import contextlib
import logging
import math
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from taxeld.config.tables import MetricsConfig
from taxeld.errors import SetupError

CLOSE_S = 2.0  # that the last writing may take
LEFT_OUT = {"v", "seq", "t"}  # of each message
NOT_COUNTED = {  # whole numbers that go up and down
    *("source_pending", "inputs_scans_waiting", "realtime_fifo", "drift_t0_modules"),
    *("calibration_suspect", "calibration_touches"),
    *("inputs_poses_fault", "inputs_poses_other_topics", "modules_layout", "modules_foreign"),
}
UNITS = {"_us": ("_seconds", 1e-6), "_s": ("_seconds", 1.0)}

log = logging.getLogger(__name__)


class Metric(NamedTuple):
    """A number of health, by the rules of OpenMetrics."""

    path: str  # in health
    name: str  # of the family
    value: float
    unit: str = ""
    counts: bool = False


def place(config: MetricsConfig) -> Path | None:
    """Where the file is kept; None: nowhere.

    Raises:
        SetupError: its directory is missing.
    """
    if not config.file:
        return None
    path = Path(config.file)
    if not path.parent.is_dir():
        raise SetupError(f"metrics.file: there is no directory {path.parent}; make it")
    return path


class MetricsFile:
    """Keeps a file up to date, if one is configured."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._health: Mapping[str, Any] | None = None  # the newest that is not written yet
        self._failed = self._closed = False
        self._change = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)
        if self._path is not None:
            self._thread.start()

    def offer(self, health: Mapping[str, Any]) -> None:
        """Hand a message that is not changed any more to the thread. Never blocks."""
        if self._path is not None:
            with self._change:
                self._health = health
                self._change.notify()

    def close(self) -> None:
        """A daemon that has ended has no metrics: the file is taken away."""
        if self._path is None:
            return
        with self._change:
            self._closed = True
            self._change.notify()
        self._thread.join(CLOSE_S)
        with contextlib.suppress(OSError):
            self._path.unlink(missing_ok=True)

    def _run(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._health is not None or self._closed)
                health, self._health = self._health, None
            if self._closed or health is None:
                return
            self._write(health)

    def _write(self, health: Mapping[str, Any]) -> None:
        assert self._path is not None  # noqa: S101  (else there is no thread)
        beside = self._path.with_name(self._path.name + ".new")
        try:
            with beside.open("w", encoding="utf-8") as file:
                os.fchmod(file.fileno(), 0o644)  # its reader is another user
                file.write(text(health, self._path.stem))
            beside.replace(self._path)
            self._failed = False
        except OSError as error:
            if not self._failed:
                log.warning("metrics.file: %s is not written (%s)", self._path, error.strerror)
            self._failed = True
            with contextlib.suppress(OSError):
                beside.unlink(missing_ok=True)


def text(health: Mapping[str, Any], daemon: str) -> str:
    """The whole file; `daemon` tells those of a machine apart."""
    label = daemon.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    lines = []
    for metric in metrics(health):
        lines.append(f"# TYPE {metric.name} {'counter' if metric.counts else 'gauge'}")
        if metric.unit:
            lines.append(f"# UNIT {metric.name} {metric.unit}")
        lines.append(f"# HELP {metric.name} {metric.path} of /taxeld/health (docs/stream.md)")
        total = "_total" if metric.counts else ""
        lines.append(f'{metric.name}{total}{{daemon="{label}"}} {metric.value}')
    return "\n".join([*lines, "# EOF", ""])


def metrics(health: Mapping[str, Any]) -> Iterator[Metric]:
    """Each number, truth value and length of a list."""
    for path, value in _leaves(health, ()):
        unit, factor = "", 1.0
        parts = list(path)
        for k, part in enumerate(path):
            suffix = next((s for s in UNITS if part.endswith(s)), "")
            if suffix:
                unit, factor = UNITS[suffix]
                parts[k] = part.removesuffix(suffix)
        name = "_".join(parts)
        counts = type(value) is int and not unit and name not in NOT_COUNTED
        number = float(len(value) if isinstance(value, list) else value) * factor
        if math.isfinite(number):
            yield Metric(
                ".".join(path), f"taxeld_{name}{unit}", number, unit.removeprefix("_"), counts
            )


def _leaves(
    part: Mapping[str, Any], path: tuple[str, ...]
) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in part.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, (*path, key))
        elif path or key not in LEFT_OUT:
            yield (*path, key), value
