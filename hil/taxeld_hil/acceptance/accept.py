"""`taxeld-hil accept`: whether a real skin is fit for use (docs/acceptance.md)."""

import contextlib
import time
from dataclasses import replace
from pathlib import Path

from taxeld.config import endpoints
from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.service.doorkeeper import array_heard
from taxeld.source.device import BusyError
from taxeld.source.recorder import Recorder
from taxeld.source.sources import Source, open_source
from taxeld_hil.acceptance.press import ask
from taxeld_hil.acceptance.received import Say, receive
from taxeld_hil.acceptance.report import AcceptanceReport

SECONDS_MIN = 5.0  # 100 scans at the usual rate: to call a taxel stuck needs half of that
SECONDS_MAX = 600.0  # all scans are held
OTHER_CURE = "; is the adapter plugged in, its driver installed?"


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
) -> AcceptanceReport:
    """Check the skin behind a target; the report and all that was received are written to `out`.

    Raises:
        SetupError: a number is out of its range, the target cannot be opened, or the layout or
            `out` cannot be used.
    """
    for option, value, least, most in (
        ("--seconds", seconds, SECONDS_MIN, SECONDS_MAX),
        ("--period-ms", period_ms, 1, 0xFFFF),
        ("--full-scale-counts", full_scale_counts, 1, 0xFFFF),
    ):
        if not least <= value <= most:
            raise SetupError(f"{option}: must be {least:g}..{most:g}, not {value:g}")
    layout = layouts.read(skin)
    config = source_of(target, period_ms)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        with Recorder(out, moves=False) as recorder:
            source = opened(target, config, layout, recorder)
            with contextlib.closing(source), array_heard(source, config.endpoint):
                got = receive(source, layout, say, seconds, period_ms, full_scale_counts)
                if presses:
                    got = replace(got, presses=ask(source, got, say))
        report = AcceptanceReport(target, when, got)
        _write(report, out, say)
    except OSError as error:  # of the files: the source handles a device's errors
        raise SetupError(f"--out: cannot write {out} ({error.strerror})") from None
    return report


def _write(report: AcceptanceReport, out: Path, say: Say) -> None:
    out.mkdir(parents=True, exist_ok=True)  # a recording makes it with its first frame
    (out / "report.txt").write_text(report.text, encoding="utf-8")
    (out / "report.json").write_text(report.json, encoding="utf-8")
    if report.modules:
        path = out / "modules.toml"
        path.write_text(report.modules, encoding="utf-8")
        say(f"the hub's modules are listed in {path}, for source.modules")


def source_of(target: str, period_ms: int) -> SourceConfig:
    """The daemon's source for `can:CHANNEL`, `serial:DEVICE[@BAUD]`, `array:ENDPOINT`, or
    `INTERFACE:CHANNEL` of any interface that python-can knows.

    Raises:
        SetupError: it is none of them.
    """
    kind, _, channel = target.partition(":")
    if not kind or not channel:
        raise SetupError(
            f"TARGET: '{target}' is none; use can:can0, slcan:/dev/ttyACM0, serial:/dev/ttyACM0, "
            "array:tcp://127.0.0.1:9870, or a python-can interface and its channel, as "
            "pcan:PCAN_USBBUS1"
        )
    if kind == "array":
        if fault := endpoints.fault(channel):
            raise SetupError(f"TARGET: {fault}")
        return SourceConfig(kind="array", endpoint=channel, period_ms=period_ms)
    if kind == "serial":
        return SourceConfig(kind="serial", channel=channel, period_ms=period_ms)
    interface = "socketcan" if kind == "can" else kind
    return SourceConfig(kind="can", interface=interface, channel=channel, period_ms=period_ms)


def opened(target: str, config: SourceConfig, layout: Layout, recorder: Recorder) -> Source:
    """The source of a target.

    Raises:
        SetupError: it cannot be opened, or another process has it.
    """
    try:
        return open_source(config, layout, recorder)
    except SetupError as error:
        said = str(error).partition(": ")[2]  # a target has no configuration key to name
        has_cure = target.partition(":")[0] in ("can", "slcan", "serial", "array")
        cure = "" if has_cure or isinstance(error, BusyError) else OTHER_CURE
        raise SetupError(f"TARGET {target}: {said}{cure}") from None
