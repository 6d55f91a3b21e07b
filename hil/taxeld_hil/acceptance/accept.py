"""`taxeld-hil accept`: whether a real skin is fit for use (docs/acceptance.md)."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.source.recorder import Recorder
from taxeld_hil.acceptance.acquire import Acquisition, Say
from taxeld_hil.acceptance.checks import checks
from taxeld_hil.acceptance.readings import IdleReadings, readings
from taxeld_hil.acceptance.report import Report
from taxeld_hil.acceptance.target import opened, source_of
from taxeld_hil.acceptance.taxels import failing, noisy, thresholds
from taxeld_hil.acceptance.values import Press, Received

TEXT, JSON, PICTURE = "report.txt", "report.json", "report.png"
MODULES = "modules.toml"
SECONDS_MIN = 5.0  # 100 scans at the usual rate: what stands still needs half of that
SECONDS_MAX = 600.0  # all scans are held


def run(
    target: str,
    skin: str,
    out: Path,
    say: Say,
    *,
    seconds: float,
    period_ms: int,
    full_scale_counts: float,
    presses: bool,
) -> Report:
    """Check the skin behind a target; the report and all that was received are written to `out`.

    Raises:
        SetupError: the target cannot be opened, or the layout or `out` cannot be used.
    """
    placed = layouts.read(skin)
    config = source_of(target, period_ms)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        with Recorder(out, moves=False) as recorder:
            source = opened(target, config, placed, recorder)
            try:
                acquisition = Acquisition(source, placed, say)
                received = acquisition.receive(seconds, period_ms, full_scale_counts)
                got = readings(placed, received.scans, period_ms / 1e3)
                if presses:
                    received = replace(received, presses=_presses(acquisition, received, got))
            finally:
                source.close()
        report = Report(target, when, received, got, checks(received, got))
        _write(report, out, say)
    except OSError as error:  # a device's own are the source's to handle
        raise SetupError(f"--out: cannot write {out} ({error.strerror})") from None
    return report


def _presses(acquisition: Acquisition, received: Received, got: IdleReadings) -> list[Press]:
    """Presses on all modules, as measured by the taxels that work."""
    full_scale = received.full_scale_counts
    bad = [*failing(got).values(), noisy(got, full_scale), ~got.present]
    usable = ~np.any(bad, axis=0)
    return acquisition.presses(got.level, thresholds(got.noise, full_scale), usable)


def _write(report: Report, out: Path, say: Say) -> None:
    out.mkdir(parents=True, exist_ok=True)  # a recording of nothing has left none
    (out / TEXT).write_text(report.text, encoding="utf-8")
    (out / JSON).write_text(report.json, encoding="utf-8")
    if report.modules:
        (out / MODULES).write_text(report.modules, encoding="utf-8")
        say(f"the hub's modules are listed in {out / MODULES}, for source.modules")
    try:
        from taxeld_hil.acceptance.draw import draw  # noqa: PLC0415  (of the extra `view`)
    except ImportError as error:
        say(f"no picture: {error}; pip install 'taxeld[view]'")
        return
    draw(report, out / PICTURE)
