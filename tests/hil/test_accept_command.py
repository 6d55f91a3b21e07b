"""`taxeld-hil accept` as a whole, on virtual skins behind real pseudo-terminals."""

import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from taxeld_hil import cli
from taxeld_protocol.modules import Module
from tests.rig.virtual_hub import StuckHub, VirtualHub

from .accept_skin import LAYOUT, MODULES, Counts, DamagingHub, Operator, SleepClock, VirtualSkin

CHECKS = ["discovery", "modules", "rate", "link", "noise", "taxels", "temperature", "press"]
FIVE = ["--seconds", "5"]


class Ran(SimpleNamespace):
    code: int
    out: Path
    printed: str

    @property
    def failed(self) -> list[str]:
        return [c["name"] for c in self.report["checks"] if c["verdict"] == "failed"]

    @property
    def report(self) -> dict:  # type: ignore[type-arg]
        return json.loads((self.out / "report.json").read_text(encoding="utf-8"))

    def findings(self, name: str) -> str:
        (check,) = (c for c in self.report["checks"] if c["name"] == name)
        return json.dumps(check["findings"], ensure_ascii=False)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SleepClock:
    """Everything that looks at a clock between device and report looks at this one."""
    made = SleepClock()
    for module in (
        "taxeld_hil.acceptance.accept",
        "taxeld_hil.acceptance.received",
        "taxeld.source.lines",
    ):
        monkeypatch.setattr(f"{module}.time", made)
    return made


@pytest.fixture
def link(tmp_path: Path) -> Path:
    """The device's name."""
    return tmp_path / "device"


@pytest.fixture
def skin(clock: SleepClock, link: Path) -> Iterator[VirtualSkin]:
    """A healthy skin behind an SLCAN adapter; tests break it."""
    with DamagingHub(link, MODULES) as hub:
        yield VirtualSkin(hub, Counts(MODULES), clock)


@pytest.fixture
def accept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    def run(skin: VirtualSkin, *more: str, kind: str = "slcan") -> Ran:
        operator, out = Operator(skin.operator), tmp_path / "report"
        target = f"{kind}:{Path(skin.hub.device).readlink()}"  # a short name, for the page
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", operator)
            code = cli.main(["accept", target, "--layout", LAYOUT, "--out", str(out), *FIVE, *more])
        return Ran(code=code, out=out, printed=operator.getvalue())

    return run


Accept = Callable[..., Ran]


def test_a_healthy_skin_passes_all_checks_and_gets_a_report_and_a_recording(
    skin: VirtualSkin, accept: Accept
) -> None:
    ran = accept(skin, "--press")
    assert (ran.code, ran.failed) == (0, []), ran.printed
    assert [c["name"] for c in ran.report["checks"]] == CHECKS
    assert {c["verdict"] for c in ran.report["checks"]} == {"passed"}
    text = (ran.out / "report.txt").read_text(encoding="utf-8")
    assert text in ran.printed
    assert "note: hub 1: version virtual 1, bootloader virtual 2, application virtual 3" in text
    assert max(map(len, text.splitlines())) <= 100
    assert sorted(p.name for p in ran.out.iterdir()) == [
        *("frames.log", "modules.toml", "report.json", "report.txt", "session.toml")
    ]
    assert (ran.out / "frames.log").stat().st_size > 0
    assert skin.was_stopped()


@pytest.mark.parametrize(
    ("options", "kind", "record"),
    [({"native": True}, "serial", "serial.bin"), ({"short_id": 9}, "slcan", "frames.log")],
    ids=["native link", "another short id"],
)
def test_a_healthy_skin_passes_over_each_link_and_under_another_short_id(
    options: dict[str, Any], kind: str, record: str, clock: SleepClock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES, **options) as hub:
        ran = accept(VirtualSkin(hub, Counts(MODULES), clock), kind=kind)
    assert (ran.code, ran.failed) == (0, []), ran.printed
    assert (ran.out / record).stat().st_size > 0
    assert re.search(r"^press +not checked +not asked for", ran.printed, re.MULTILINE)


def dead_taxel(skin: VirtualSkin) -> None:
    skin.counts.fixed[3, 4] = 0


def swapped(skin: VirtualSkin) -> None:
    skin.wired_as = {2: 4, 4: 2}


def unpressed(skin: VirtualSkin) -> None:
    skin.wired_as = {3: 99}


def damaged(skin: VirtualSkin) -> None:
    assert isinstance(skin.hub, DamagingHub)
    skin.hub.damage_every = 9


def slow(skin: VirtualSkin) -> None:
    skin.period_ms = 80


@pytest.mark.parametrize(
    ("fault", "more", "check", "finding"),
    [
        (dead_taxel, ["--press"], "taxels", "T4 of module 3 (hub 1, position 2)"),
        (swapped, ["--press"], "press", "modules 2 and 4"),
        (unpressed, ["--press"], "press", "module 3"),
        (damaged, [], "link", "wrong checksum"),
        (slow, [], "rate", "80.0 ms"),
    ],
)
def test_a_fault_of_the_skin_fails_its_own_check_alone(
    fault: Callable[[VirtualSkin], None],
    more: list[str],
    check: str,
    finding: str,
    skin: VirtualSkin,
    accept: Accept,
) -> None:
    fault(skin)
    ran = accept(skin, *more)
    assert (ran.code, ran.failed) == (1, [check]), ran.printed
    assert finding in ran.findings(check)


@pytest.mark.parametrize(
    ("found", "finding"),
    [
        ([MODULES[0], *MODULES[2:]], "module 2"),
        ([replace(MODULES[0], mask=0x3FF, channels=10), *MODULES[1:]], "T10"),
        ([replace(MODULES[0], grouping=1), *MODULES[1:]], "is grouped (grouping 1)"),
    ],
    ids=["missing module", "cut taxel", "grouped module"],
)
def test_modules_that_are_not_the_layouts_fail_the_module_table_alone(
    found: list[Module], finding: str, clock: SleepClock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, found) as hub:
        ran = accept(VirtualSkin(hub, Counts(found), clock), "--press")
    assert (ran.code, ran.failed) == (1, ["modules"]), ran.printed
    assert finding in ran.findings("modules")


def test_the_modules_are_listed_in_the_hubs_order_for_who_listens_later(
    clock: SleepClock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES[::-1]) as hub:
        ran = accept(VirtualSkin(hub, Counts(MODULES[::-1]), clock))
    assert (ran.code, ran.failed) == (0, []), ran.printed
    path = ran.out / "modules.toml"
    assert f"listed in {path}, for source.modules" in ran.printed
    modules = tomllib.loads(path.read_text(encoding="utf-8"))["modules"]
    assert modules == [[module.sui, module.mask] for module in MODULES[::-1]]


def test_a_hub_that_stays_in_its_bootloader_fails_discovery_and_is_called_by_its_name(
    clock: SleepClock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES) as hub:
        hub.ihb = StuckHub(MODULES)
        ran = accept(VirtualSkin(hub, Counts(MODULES), clock))
    assert (ran.code, ran.failed) == (1, ["discovery"])
    assert "from a hub's bootloader" in ran.findings("discovery")
    assert not (ran.out / "modules.toml").exists()


def test_presses_that_are_interrupted_still_give_a_report(
    skin: VirtualSkin, accept: Accept, monkeypatch: pytest.MonkeyPatch
) -> None:
    def leave(asked: str) -> None:
        skin.on_text(asked)
        if asked.startswith("3/4 press"):
            raise KeyboardInterrupt

    monkeypatch.setattr(skin, "operator", leave)
    ran = accept(skin, "--press")
    assert (ran.code, ran.failed) == (1, ["press"]), ran.printed
    assert "2 of 4 modules answered" in ran.printed


def test_without_an_answer_discovery_fails_and_names_what_to_check(
    clock: SleepClock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES) as hub:
        silent = VirtualSkin(hub, Counts(MODULES), clock)
        clock.on_sleep = lambda: None
        ran = accept(silent, "--press")
    assert (ran.code, ran.failed) == (1, ["discovery"])
    assert "120 Ω" in ran.printed
    assert "no module that can be pressed" in ran.printed


def test_a_report_is_not_written_over_another(
    skin: VirtualSkin, accept: Accept, capsys: pytest.CaptureFixture[str]
) -> None:
    first = accept(skin)
    kept = (first.out / "report.json").read_bytes()
    assert accept(skin).code == 2
    assert "name another directory" in capsys.readouterr().err
    assert (first.out / "report.json").read_bytes() == kept
