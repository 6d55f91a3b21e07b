"""`taxeld-hil accept` as a whole, on virtual skins."""

import json
import sys
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from taxeld_hil import cli
from taxeld_protocol.virtual_ihb import Phase, VirtualIhb
from tests.rig.array_skin import LAYOUT as ARRAY
from tests.rig.array_skin import ArraySkin
from tests.rig.virtual_hub import StuckHub

from .accept_skin import LAYOUT, MODULES, Counts, Operator, SleepClock, VirtualSkin

CHECKS = ["discovery", "modules", "rate", "link", "taxels", "temperature", "press"]
PRESS = ["--press"]
Prepare = Callable[[VirtualSkin], None]


class Ran(NamedTuple):
    code: int
    out: Path
    printed: str
    was_stopped: bool  # the skin, in the end

    @property
    def rules(self) -> list[dict[str, Any]]:
        return json.loads((self.out / "report.json").read_text(encoding="utf-8"))["rules"]

    @property
    def failed(self) -> dict[str, str]:
        """Rules that do not hold, and what they say."""
        broken = [rule for rule in self.rules if rule["holds"] is False]
        return {f"{r['check']} {r['what']}": f"{r['measured']} → {r['cure']}" for r in broken}


Accept = Callable[..., Ran]


@pytest.fixture
def accept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Accept:
    """The command, on a skin that is healthy until `prepare` has seen it."""
    clock, out = SleepClock(), tmp_path / "report"
    for module in ("accept", "received"):
        monkeypatch.setattr(f"taxeld_hil.acceptance.{module}.time", clock)

    def run(
        *more: str,
        prepare: Prepare = bool,
        found: Sequence[Any] = MODULES,
        native: bool = False,
        short_id: int = 1,
        kind: type[VirtualIhb] = VirtualIhb,
    ) -> Ran:
        phase = Phase.MODULES if native else Phase.BOOTLOADER
        hub = kind(found, short_id=short_id, phase=phase)
        skin = VirtualSkin(hub, Counts(found), clock, native=native)
        prepare(skin)
        operator = Operator(skin.operator)
        target = "serial:device" if native else "slcan:device"
        line = ["accept", target, "--layout", LAYOUT, "--out", str(out), "--seconds", "5"]
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", operator)
            patch.setattr("taxeld.source.opening.open_device", lambda _: skin)
            code = cli.main([*line, *more])
        return Ran(code, out, operator.getvalue(), not hub.auto_sync)

    return run


def test_a_healthy_skin_passes_and_gets_a_report_and_a_recording(accept: Accept) -> None:
    ran = accept(*PRESS)
    assert (ran.code, ran.failed) == (0, {}), ran.printed
    assert ran.was_stopped
    assert [*dict.fromkeys(rule["check"] for rule in ran.rules)] == CHECKS
    assert {rule["holds"] for rule in ran.rules} == {True}
    text = (ran.out / "report.txt").read_text(encoding="utf-8")
    assert text in ran.printed
    assert "hub 1: version virtual 1, bootloader virtual 2" in " ".join(text.split())
    assert max(map(len, text.splitlines())) <= 100
    assert sorted(p.name for p in ran.out.iterdir()) == [
        *("frames.log", "modules.toml", "report.json", "report.txt", "session.toml")
    ]
    assert (ran.out / "frames.log").stat().st_size > 0


@pytest.mark.parametrize(
    ("options", "record"),
    [
        ({"native": True}, "serial.bin"),
        ({"short_id": 9}, "frames.log"),
        ({"found": MODULES[::-1]}, "frames.log"),
    ],
    ids=["native link", "another short id", "another order"],
)
def test_a_healthy_skin_passes_over_each_link_and_its_modules_are_listed_in_their_order(
    options: dict[str, Any], record: str, accept: Accept
) -> None:
    ran = accept(**options)
    assert (ran.code, ran.failed) == (0, {}), ran.printed
    assert (ran.out / record).stat().st_size > 0
    assert "-      press        modules: not asked for" in ran.printed
    path = ran.out / "modules.toml"
    assert f"listed in {path}, for source.modules" in ran.printed
    modules = tomllib.loads(path.read_text(encoding="utf-8"))["modules"]
    assert modules == [[module.sui, module.mask] for module in options.get("found", MODULES)]


def left(skin: VirtualSkin) -> None:
    """The operator leaves at the third module."""

    def leave(asked: str) -> None:
        skin.on_text(asked)
        if asked.startswith("3/4 press"):
            raise KeyboardInterrupt

    skin.operator = leave


FIRST, *REST = MODULES
FAULTS: list[tuple[str, str, dict[str, Any]]] = [
    # the rule that does not hold, what it says, the skin
    ("press answers", "modules 2 and 4 are swapped",
     {"prepare": lambda skin: skin.wired_as.update({2: 4, 4: 2})}),
    ("press answers", "2 of 4 modules answered", {"prepare": left}),
    ("modules with other taxels", "is grouped (grouping 1)",
     {"found": [replace(FIRST, grouping=1), *REST]}),
    ("discovery hubs", "bootloader", {"kind": StuckHub}),
]  # fmt: skip


@pytest.mark.parametrize(("rule", "says", "options"), FAULTS)
def test_a_fault_of_the_skin_breaks_its_own_rule_alone(
    rule: str, says: str, options: dict[str, Any], accept: Accept
) -> None:
    ran = accept(*PRESS, **options)
    assert (ran.code, list(ran.failed)) == (1, [rule]), ran.printed
    assert says in ran.failed[rule]
    sends_none = rule == "discovery hubs" or "grouping" in says
    assert ("no module that can be pressed" in ran.printed) == sends_none
    assert (ran.out / "modules.toml").exists() != sends_none


def test_a_skin_that_sends_arrays_passes_and_has_no_modules_to_list(tmp_path: Path) -> None:
    """In real time, so the pace of the scans is this machine's matter."""
    out, here = tmp_path / "report", f"ipc://{tmp_path}"
    with ArraySkin(f"{here}/skin", f"{here}/robot", "counts", idle=10**6):
        line = ["accept", f"array:{here}/skin", "--layout", ARRAY, "--out", str(out)]
        cli.main([*line, "--seconds", "6"])
    ran = Ran(0, out, "", was_stopped=True)
    assert {name for name in ran.failed if not name.startswith("rate")} == set()
    said = {f"{rule['check']} {rule['what']}": rule["measured"] for rule in ran.rules}
    assert said["modules of the layout"] == "8 of 8 answered"
    assert said["taxels at rest"].startswith("80 of 80")
    assert {path.name for path in out.iterdir()} == {
        *("array.jsonl", "report.json", "report.txt", "session.toml")
    }


def test_a_report_is_not_written_over_another(
    accept: Accept, capsys: pytest.CaptureFixture[str]
) -> None:
    first = accept()
    kept = (first.out / "report.json").read_bytes()
    assert accept().code == 2
    assert "name another directory" in capsys.readouterr().err
    assert (first.out / "report.json").read_bytes() == kept
