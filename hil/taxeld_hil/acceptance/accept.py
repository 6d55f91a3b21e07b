"""`taxeld-hil accept`: whether a real skin is fit for use (docs/acceptance.md).

It makes a page of text that a person can act on, and the same as JSON.
"""

import contextlib
import json
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taxeld.commands.init import connection
from taxeld.config.tables import Config, SourceConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.service.inputs import Inputs
from taxeld.source import modules
from taxeld.source.recorder import Recorder
from taxeld.stream.link import Link
from taxeld_hil.acceptance.checks import rules
from taxeld_hil.acceptance.received import Received, Say, pressed_by_hand, receive
from taxeld_hil.rules import Rule, failed, lines
from taxeld_protocol.decoder import Decoder

SECONDS_MIN = 5.0  # 100 scans at the usual rate
SECONDS_MAX = 600.0  # all scans are held
VERSION = 2  # of report.json


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
) -> bool:
    """Check the skin behind a target; → whether all rules hold. The report and all that was
    received are written to `out`.

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
    config = SourceConfig(**connection(target, "TARGET"), period_ms=period_ms)
    when = time.strftime("%Y-%m-%d %H:%M:%S")
    try:
        with contextlib.ExitStack() as stack:
            recorder = stack.enter_context(Recorder(out, moves=False))
            try:
                link = Link({}, lambda *_: None, {})
                inputs = Inputs(Config(source=config), [layout], link, recorder)
            except SetupError as error:  # a target has no configuration key to name
                raise SetupError(f"TARGET {target}: {str(error).partition(': ')[2]}") from None
            stack.enter_context(contextlib.closing(inputs))
            got = receive(inputs, layout, say, seconds, period_ms, full_scale_counts)
            if presses:
                got = pressed_by_hand(inputs, got, say)
        found = rules(got)
        text = page(target, when, got, found)
        out.mkdir(parents=True, exist_ok=True)  # a recording makes it with its first frame
        (out / "report.txt").write_text(text, encoding="utf-8")
        as_text = json.dumps(report(target, when, got, found), indent=1)
        (out / "report.json").write_text(as_text + "\n", encoding="utf-8")
        decoder, path = inputs.sources[0].decoder, out / modules.FILE
        whole = modules.complete(decoder) if isinstance(decoder, Decoder) else {}
        if tables := {hub: whole[hub] for hub in got.tables if hub in whole}:
            modules.write(path, tables)
            say(f"the hub's modules are listed in {path}, for source.modules")
    except OSError as error:  # of the files: the source handles a device's errors
        raise SetupError(f"--out: cannot write {out} ({error.strerror})") from None
    say(f"\n{text}\nreport and recording in {out}")
    return not failed(found)


def page(target: str, when: str, got: Received, found: Sequence[Rule]) -> str:
    """The report for people."""
    bad, seconds = failed(found), got.span[1] - got.span[0]
    verdict = f"FAILED, {len(bad)} of {len(found)} rules" if bad else "PASSED"
    head = [
        f"skin acceptance: {verdict}",
        f"target {target}, {when}, {seconds:.0f} s untouched",
        f"layout {got.layout.name}: {len(got.layout)} taxels on "
        f"{len(np.unique(got.layout.uid >> 4))} modules",
        "",
    ]
    return "\n".join([*head, *lines(found)]) + "\n"


def report(target: str, when: str, got: Received, found: Sequence[Rule]) -> dict[str, object]:
    """The report for programs, with a row for each taxel."""
    none = np.full(len(got.layout), np.nan)
    read = got.untouched
    columns = {
        "level": none if read is None else read.level,
        "noise": none if read is None else read.noise,
        "press_counts": np.max([p.peak for p in got.presses], axis=0) if got.presses else none,
    }
    return {
        "v": VERSION,
        "passed": not failed(found),
        "target": target,
        "when": when,
        "seconds": round(got.span[1] - got.span[0], 3),
        "layout": {"name": got.layout.name, "digest": got.layout.digest},
        "period_ms": got.period_ms,
        "full_scale_counts": got.full_scale_counts,
        "rules": [rule._asdict() for rule in found],
        "taxels": [
            {"uid": uid}
            | {k: round(float(c[i]), 4) if np.isfinite(c[i]) else None for k, c in columns.items()}
            for i, uid in enumerate(got.layout.uid.tolist())
        ],
    }
