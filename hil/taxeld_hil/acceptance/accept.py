"""`taxeld-hil accept`: whether a real skin is fit for use (docs/acceptance.md)."""

import time
from dataclasses import replace
from pathlib import Path

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.source.recorder import Recorder
from taxeld_hil.acceptance.press import ask
from taxeld_hil.acceptance.received import Say, receive
from taxeld_hil.acceptance.report import Report
from taxeld_hil.acceptance.target import opened, source_of

SECONDS_MIN = 5.0  # 100 scans at the usual rate: to call a taxel stuck needs half of that
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
    layout = layouts.read(skin)
    config = source_of(target, period_ms)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        with Recorder(out, moves=False) as recorder:
            source = opened(target, config, layout, recorder)
            try:
                got = receive(source, layout, say, seconds, period_ms, full_scale_counts)
                if presses:
                    got = replace(got, presses=ask(source, got, say))
            finally:
                source.close()
        report = Report(target, when, got)
        _write(report, out, say)
    except OSError as error:  # a device's own are the source's to handle
        raise SetupError(f"--out: cannot write {out} ({error.strerror})") from None
    return report


def _write(report: Report, out: Path, say: Say) -> None:
    out.mkdir(parents=True, exist_ok=True)  # a recording of nothing has left none
    (out / "report.txt").write_text(report.text, encoding="utf-8")
    (out / "report.json").write_text(report.json, encoding="utf-8")
    if report.modules:
        path = out / "modules.toml"
        path.write_text(report.modules, encoding="utf-8")
        say(f"the hub's modules are listed in {path}, for source.modules")
    try:
        from taxeld_hil.acceptance.draw import draw  # noqa: PLC0415  (of the extra `view`)
    except ImportError as error:
        say(f"no picture: {error}; pip install 'taxeld[view]'")
        return
    draw(report, out / "report.png")
