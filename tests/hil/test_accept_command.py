"""`taxeld-hil accept` as a whole, on virtual skins behind real pseudo-terminals."""

import json
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from taxeld_hil import cli
from taxeld_protocol.cyskin import Command, Packet
from taxeld_protocol.virtual_ihb import Answer, VirtualIhb
from tests.virtual_hub import VirtualHub

from .accept_skin import (
    LAYOUT,
    MODULES,
    Clock,
    Counts,
    DamagingHub,
    Operator,
    VirtualSkin,
)  # fmt: skip

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
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """Everything that looks at a clock between device and report looks at this one."""
    made = Clock()
    for module in (
        "taxeld_hil.acceptance.accept", "taxeld_hil.acceptance.received",
        "taxeld.source.lines", "taxeld.source.slcan_device",
    ):  # fmt: skip
        monkeypatch.setattr(f"{module}.time", made)
    return made


@pytest.fixture
def link(tmp_path: Path) -> Path:
    """The device's name."""
    return tmp_path / "device"


@pytest.fixture
def skin(clock: Clock, link: Path) -> Iterator[VirtualSkin]:
    """A healthy skin behind an SLCAN adapter; tests break it."""
    with DamagingHub(link, MODULES) as hub:
        yield VirtualSkin(hub, Counts(MODULES), clock)


@pytest.fixture
def accept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Ran]:
    def run(skin: VirtualSkin, *more: str, kind: str = "slcan", view: bool = False) -> Ran:
        operator, out = Operator(skin.operator), tmp_path / "report"
        target = f"{kind}:{Path(skin.hub.device).readlink()}"  # a short name, for the page
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", operator)
            if not view:  # as where the extra is not installed
                patch.setitem(sys.modules, "taxeld_hil.acceptance.draw", None)
            code = cli.main(["accept", target, "--layout", LAYOUT, "--out", str(out), *FIVE, *more])
        return Ran(code=code, out=out, printed=operator.getvalue())

    return run


Accept = Callable[..., Ran]


def test_a_healthy_skin_passes_all_checks_and_gets_a_report_a_picture_and_a_recording(
    skin: VirtualSkin, accept: Accept
) -> None:
    ran = accept(skin, "--press", view=True)
    assert (ran.code, ran.failed) == (0, []), ran.printed
    assert [c["name"] for c in ran.report["checks"]] == CHECKS
    assert {c["verdict"] for c in ran.report["checks"]} == {"passed"}
    text = (ran.out / "report.txt").read_text(encoding="utf-8")
    assert text in ran.printed
    assert max(map(len, text.splitlines())) <= 100
    assert (ran.out / "report.png").stat().st_size < 300_000
    assert (ran.out / "frames.log").stat().st_size > 0
    assert skin.was_stopped()


def test_the_native_serial_link_is_checked_the_same_way(
    clock: Clock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES, native=True) as hub:
        ran = accept(VirtualSkin(hub, Counts(MODULES), clock), kind="serial")
    assert (ran.code, ran.failed) == (0, []), ran.printed
    assert (ran.out / "serial.bin").stat().st_size > 0


def test_without_matplotlib_all_but_the_picture_is_there(skin: VirtualSkin, accept: Accept) -> None:
    ran = accept(skin)
    assert ran.code == 0
    assert "no picture: " in ran.printed
    assert "pip install 'taxeld[view]'" in ran.printed
    assert sorted(p.name for p in ran.out.iterdir()) == [
        *("frames.log", "modules.toml", "report.json", "report.txt", "session.toml")
    ]


def test_the_modules_are_listed_in_the_hubs_order_for_who_listens_later(
    clock: Clock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES[::-1]) as hub:
        ran = accept(VirtualSkin(hub, Counts(MODULES[::-1]), clock))
    assert (ran.code, ran.failed) == (0, []), ran.printed
    path = ran.out / "modules.toml"
    assert f"listed in {path}, for source.modules" in ran.printed
    modules = tomllib.loads(path.read_text(encoding="utf-8"))["modules"]
    assert modules == [[module.sui, module.mask] for module in MODULES[::-1]]


def test_a_hub_that_stays_in_its_bootloader_fails_discovery_and_is_called_by_its_name(
    clock: Clock, link: Path, accept: Accept
) -> None:
    class Stuck(VirtualIhb):
        def answer(self, packet: Packet) -> list[Answer]:
            starts = packet.command == Command.MODULE_PROGRAM_END
            return [] if starts else super().answer(packet)

    with VirtualHub(link, MODULES) as hub:
        hub.ihb = Stuck(MODULES)
        ran = accept(VirtualSkin(hub, Counts(MODULES), clock))
    assert (ran.code, ran.failed) == (1, ["discovery"])
    assert "from a hub's bootloader" in ran.findings("discovery")
    assert not (ran.out / "modules.toml").exists()


def test_without_presses_all_else_is_checked(skin: VirtualSkin, accept: Accept) -> None:
    ran = accept(skin)
    assert ran.code == 0
    assert re.search(r"^press +not checked +not asked for", ran.printed, re.MULTILINE)


def test_a_dead_taxel_fails_the_taxels_alone(skin: VirtualSkin, accept: Accept) -> None:
    skin.counts.fixed[3, 4] = 0
    ran = accept(skin, "--press")
    assert (ran.code, ran.failed) == (1, ["taxels"]), ran.printed
    assert "T4 of module 3 (hub 1, position 2)" in ran.findings("taxels")


def test_a_missing_module_fails_the_module_table_alone(
    clock: Clock, link: Path, accept: Accept
) -> None:
    rest = [module for module in MODULES if module.sui != 2]
    with VirtualHub(link, rest) as hub:
        ran = accept(VirtualSkin(hub, Counts(rest), clock), "--press")
    assert (ran.code, ran.failed) == (1, ["modules"]), ran.printed
    assert "module 2" in ran.findings("modules")


def test_a_swapped_pair_of_modules_fails_the_presses_alone(
    skin: VirtualSkin, accept: Accept
) -> None:
    skin.wired_as = {2: 4, 4: 2}
    ran = accept(skin, "--press")
    assert (ran.code, ran.failed) == (1, ["press"]), ran.printed
    assert "modules 2 and 4" in ran.findings("press")


def test_a_module_that_is_not_pressed_in_time_fails(skin: VirtualSkin, accept: Accept) -> None:
    skin.wired_as = {3: 99}
    ran = accept(skin, "--press")
    assert (ran.code, ran.failed) == (1, ["press"]), ran.printed
    assert "module 3" in ran.findings("press")


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


def test_corrupted_frames_fail_the_link_alone(skin: VirtualSkin, accept: Accept) -> None:
    skin.hub.damage_every = 9
    ran = accept(skin)
    assert (ran.code, ran.failed) == (1, ["link"]), ran.printed
    assert "wrong checksum" in ran.findings("link")


def test_a_slow_hub_fails_the_rate_alone(skin: VirtualSkin, accept: Accept) -> None:
    skin.period_ms = 80
    ran = accept(skin)
    assert (ran.code, ran.failed) == (1, ["rate"]), ran.printed
    assert "80.0 ms" in ran.findings("rate")


def test_a_taxel_that_was_cut_off_fails_the_module_table_alone(
    clock: Clock, link: Path, accept: Accept
) -> None:
    cut = [replace(MODULES[0], mask=0x3FF, channels=10), *MODULES[1:]]
    with VirtualHub(link, cut) as hub:
        ran = accept(VirtualSkin(hub, Counts(cut), clock))
    assert (ran.code, ran.failed) == (1, ["modules"]), ran.printed
    assert "T10" in ran.findings("modules")


def test_a_hub_that_is_given_another_short_id_is_one_hub(
    clock: Clock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES, short_id=9) as hub:
        ran = accept(VirtualSkin(hub, Counts(MODULES), clock))
    assert (ran.code, ran.failed) == (0, []), ran.printed


def test_without_an_answer_discovery_fails_and_names_what_to_check(
    clock: Clock, link: Path, accept: Accept
) -> None:
    with VirtualHub(link, MODULES) as hub:
        silent = VirtualSkin(hub, Counts(MODULES), clock)
        clock.on_sleep = lambda: None
        ran = accept(silent, "--press")
    assert (ran.code, ran.failed) == (1, ["discovery"])
    assert "120 Ω" in ran.printed
    assert "no module that can be pressed" in ran.printed


@pytest.mark.parametrize(
    ("target", "more", "expected"),
    [
        ("slcan:/dev/nothing", [], "plugged in"),
        ("serial:/dev/nothing", [], "plugged in"),
        ("serial:/dev/nothing@fast", [], "'fast' is no baud rate"),
        ("slcan:/dev/nothing@fast", [], "'fast' is no baud rate; use slcan:/dev/nothing@115200"),
        ("serial:/dev/nothing@99999999999999999999", [], "is no baud rate"),
        ("no_such:x", [], "driver installed"),
        ("can0", [], "use can:can0"),
        ("slcan:/dev/nothing", ["--seconds", "1"], "--seconds: must be 5..600"),
        ("slcan:/dev/nothing", ["--seconds", "nan"], "--seconds: must be 5..600"),
        ("slcan:/dev/nothing", ["--period-ms", "0"], "--period-ms: must be 1..65535"),
        ("slcan:/dev/nothing", ["--layout", "nothing.json"], "skin.layout"),
    ],
)
def test_wrong_arguments_are_one_line_and_exit_status_2(
    target: str, more: list[str], expected: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report"
    code = cli.main(["accept", target, "--layout", LAYOUT, "--out", str(out), *more])
    error = capsys.readouterr().err
    assert (code, error.count("\n")) == (2, 1)
    assert expected in error
    assert not out.exists()


def test_a_report_is_not_written_over_another(
    skin: VirtualSkin, accept: Accept, capsys: pytest.CaptureFixture[str]
) -> None:
    first = accept(skin)
    kept = (first.out / "report.json").read_bytes()
    assert accept(skin).code == 2
    assert "name another directory" in capsys.readouterr().err
    assert (first.out / "report.json").read_bytes() == kept
