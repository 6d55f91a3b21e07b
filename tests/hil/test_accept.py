"""`taxeld-hil accept`: each fault of a skin breaks its own rule, by a recording of it."""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taxeld.config.tables import SkinConfig
from taxeld.layout import read as layouts
from taxeld.skin.skin import Skin
from taxeld.source.recorder import Recorder
from taxeld.source.session import Pass
from taxeld_hil import cli, rules
from taxeld_hil.acceptance import checks
from taxeld_hil.acceptance.recorded import RecordedSkin
from taxeld_hil.rig.virtual_ihb import VirtualIhb
from taxeld_protocol.array import ArrayFrame
from taxeld_protocol.decoder import MISSING, Scan
from taxeld_protocol.modules import Module, wired
from tests.rig.commands import refused
from tests.rig.simulated_skin import PERIOD_S, SimulatedSkin
from tests.rig.virtual_hub import frames_of, told

LAYOUT = "cylinder:rows=2,columns=20,radius_m=0.06,pitch_m=0.015"  # four modules of ten taxels
SKIN = layouts.read(LAYOUT)
MODULES = tuple(wired(SKIN.uid.tolist()))
A, B, C, D = MODULES
SERIAL = SKIN.uid >> 4
REST, PRESSED, AWAY = 300, 8, 12  # scans: at first, of a press, and after it
NUMBERS = np.arange(1000)  # of scans

Change = Callable[[int, Scan], Scan | None]


def scans(
    skin: SimulatedSkin,
    presses: tuple[int, ...] = (1, 2, 3, 4),
    peak: float = 9e3,
    rest: int = REST,
) -> list[Scan]:
    """A skin at rest, and then a press of each of those modules (SUI)."""
    found = [skin.scan() for _ in range(rest)]
    for sui in presses:
        skin.press = np.where(sui == SERIAL, peak * (0.4 + 0.06 * (SKIN.uid & 0xF)), 0.0)
        found += [skin.scan() for _ in range(PRESSED)]
        skin.press = 0.0 * skin.press
        found += [skin.scan() for _ in range(AWAY)]
    return found


def heard(
    modules: tuple[Module, ...] = MODULES,
    noise: float = 34.0,
    spread: dict[int, float] | None = None,
    fixed: dict[int, int] | None = None,
    change: Change = lambda _, scan: scan,
    link: dict[str, int] | None = None,
    end_s: float = 0.0,
    silent: tuple[int, ...] = (),
    refusal: str = "",
    **pressed: Any,
) -> RecordedSkin:
    """A healthy skin, but for what is given. `spread`: times the noise, of taxels; `end_s`: of the
    recording, after the last scan."""
    skin = SimulatedSkin(SKIN, noise=noise, modules=modules)
    for taxel, times in (spread or {}).items():
        skin.spread[taxel] = times
    skin.fixed = fixed or {}
    got = RecordedSkin(Skin(SKIN, SkinConfig(), silent_s=np.inf), 50)
    for scan in filter(None, map(change, NUMBERS.tolist(), scans(skin, **pressed))):
        got.take(scan)
        got.end_t = max(got.end_t, scan.t + end_s)
    got.link = Counter(packets=4000, frames=9000) + Counter(link or {})
    got.silent, got.refusal = [*silent], refusal
    return got


def at(times: Any) -> Change:
    """Scans whose times follow from their numbers; those at nan are lost."""
    t = 1000.0 + np.asarray(times)
    return lambda k, scan: None if np.isnan(t[k]) else replace(scan, t=t[k])


def lost(numbers: Any) -> Change:
    return at(np.where(np.isin(NUMBERS, numbers), np.nan, PERIOD_S * NUMBERS))


def jumping_t0(k: int, scan: Scan) -> Scan:
    return replace(scan, counts=(scan.counts[0] + 300 * (k > 150), *scan.counts[1:]))


def no_scan(_: int, __: Scan) -> None:
    return None


def torn(k: int, scan: Scan) -> Scan:
    return replace(scan, counts=(*scan.counts[:40], *[MISSING] * 4)) if k % 20 == 10 else scan


OF_LAYOUT, FOREIGN, HUB = "modules of the layout", "modules not in the layout", "rate hub 1"
MISSED, DAMAGE, NOISY = "rate missed by hub 1", "link damage", "taxels noisy"
FAULTS: list[tuple[str, str, dict[str, Any]]] = [
    # rules that do not hold, what the first says, what is wrong
    ("modules hubs", "none sent a scan → 'taxeld record' says why", {"change": no_scan}),
    ("modules refused", "hub 2 is refused", {"refusal": "hub 2 is refused: it is grouped"}),
    ("modules of hubs that sent no scan", "hub 2 → switch", {"silent": (2,)}),
    (OF_LAYOUT, "3 of 4 answered; 2 did not, so 10 taxels",
     {"modules": (A, C, D), "presses": (1, 3, 4)}),
    (FOREIGN, "module 9 (hub 1, position 4)", {"modules": (*MODULES, replace(A, sui=9))}),
    (f"{OF_LAYOUT}|{FOREIGN}", "4 did not", {"modules": (A, B, C, replace(D, sui=9))}),
    ("modules with one serial number", "position 3), 2 times", {"modules": (A, B, C, D, D)}),
    ("modules that leave out taxels", "T9, T10 of module 1 (hub 1, position 0)",
     {"modules": (replace(A, mask=0x1FF, channels=9), B, C, D)}),
    (HUB, "80.0 ms → ask for fewer", {"change": at(0.08 * NUMBERS)}),
    (HUB, "25.0 ms → ask", {"change": at(0.025 * NUMBERS)}),
    ("rate evenness of hub 1", "within 14.0 ms",
     {"change": at(PERIOD_S * NUMBERS + 0.014 * (NUMBERS % 7 == 0))}),
    (MISSED, "10 of 380 scans", {"change": lost(range(30, 130, 10))}),
    (MISSED, "99 of 479", {"end_s": 5.0}),
    (f"{MISSED}|{DAMAGE}", "19 of 380", {"change": torn, "link": {"crc_errors": 19}}),
    ("rate whole scans of hub 1", "5 → record longer", {"change": lost(range(5, 1000))}),
    (DAMAGE, "crc_errors 6 → check the bus's ends", {"link": {"crc_errors": 6}}),
    (DAMAGE, "index_errors 6 → two hubs may share", {"link": {"index_errors": 6}}),
    (DAMAGE, "orphan 40", {"link": {"orphan": 40}}),
    ("taxels seconds at rest", "3.0 → touch nothing at first; 1 was the first", {"rest": 60}),
    (NOISY, "T5 of module 1 (hub 1, position 0), noise", {"spread": {4: 15.0}}),
    (NOISY, "the whole module: T1, T2", {"spread": dict.fromkeys(range(10, 20), 15.0)}),
    (NOISY, "T5 of module 1 (hub 1, position 0), without a baseline", {"spread": {4: 75.0}}),
    ("taxels dead", "T4 of module 3 (hub 1, position 2)", {"fixed": {23: 0}}),
    ("taxels dead|press modules", "the whole module: T1",
     {"fixed": dict.fromkeys(range(10, 20), 0)}),
    ("taxels saturated", "T1 of module 4", {"fixed": {30: 43_000}}),
    ("taxels stuck", "T10 of module 4", {"fixed": {39: 10_123}}),
    ("temperature without T0", "module 2 (hub 1",
     {"modules": (A, replace(B, mask=0x7FE, channels=10), C, D)}),
    ("temperature 0, or 43000 and more", "T0 of module 1 (hub 1",
     {"change": lambda _, scan: replace(scan, counts=(0, *scan.counts[1:]))}),
    ("temperature jumps within a second", "T0 of module 1 (hub 1, position 0): ",
     {"change": jumping_t0}),
    ("press modules", "3 of 4 felt a press; silent: module 3 (hub 1, position 2)",
     {"presses": (4, 1, 2)}),
    ("press strength", "modules 1, 2, 3, 4 felt 9", {"peak": 900.0}),
]  # fmt: skip


def failed(got: RecordedSkin) -> dict[str, str]:
    """The rules that do not hold, with all that they say."""
    return {
        f"{rule.check} {rule.what}": f"{rule.measured} → {rule.cure}"
        for rule in rules.failed(checks.rules(got))
    }


@pytest.mark.parametrize(("broken", "says", "given"), FAULTS)
def test_a_fault_breaks_its_own_rule_alone_and_is_named(
    broken: str, says: str, given: dict[str, Any]
) -> None:
    found = failed(heard(**given))
    assert list(found) == broken.split("|")
    assert says in next(iter(found.values()))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({}, "4 of 4 felt a press"),
        ({"presses": ()}, "none was pressed"),
        ({"presses": (3, 1, 4, 2)}, "3 (15 s), 1 (16 s), 4 (17 s), 2 (18 s)"),
        ({"peak": 31e3}, "raise full_scale_counts"),
        ({"modules": (replace(A, mask=0xFFF, channels=12), B, C, D)}, "4 of 4 answered"),
        ({"noise": 0.2, "fixed": {2: 10_000}}, "looks like a quiet one"),
        ({"noise": 130.0}, "40 of 40"),  # a large curved patch
        ({"change": lambda k, s: replace(s, counts=tuple(c + k // 20 for c in s.counts))}, "40"),
    ],
)
def test_what_is_no_fault_breaks_no_rule(given: dict[str, Any], says: str) -> None:
    got = heard(**given)
    assert failed(got) == {}
    assert says in " ".join(rule.measured for rule in checks.rules(got))


@pytest.mark.parametrize("n", [0, 1, 2, 3, 19, 21])
def test_of_few_scans_nothing_but_rate_and_rest_is_judged(n: int) -> None:
    found = failed(heard(change=lost(range(n, 1000))))
    assert {name.split()[0] for name in found} <= {"rate", "modules" if not n else "taxels"}


BUS = 'source = {{kind = "can", channel = "can{}"}}\n'
ARRAY = 'source = {kind = "array", endpoint = "ipc:///nowhere"}\n'
ON_SKIN = f'layout = "{LAYOUT}"\n'
LINKS = "".join(f"[[skin]]\n{ON_SKIN}{BUS.format(k)}" for k in range(2))


@pytest.mark.parametrize(
    ("config", "of_another"),
    [
        (f"{BUS.format(0)}[skin]\n{ON_SKIN}", "4 of 6 answered; 5, 6 did not"),
        (f"{ARRAY}[skin]\n{ON_SKIN}", "has 60 taxels, and arrays have 40"),
        (LINKS, ""),
    ],
    ids=["bus", "array", "links"],
)
def test_a_recording_of_a_healthy_skin_passes(
    config: str, of_another: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    skin, hub, links = SimulatedSkin(SKIN), VirtualIhb(MODULES), 1 + (config == LINKS)
    with Recorder(tmp_path, moves=False) as recorder:
        declared = frames_of(told(hub), t=skin.t)
        for scan in scans(skin):
            items: list[Any] = [*declared, *frames_of(hub.sensor_data(scan.counts), t=scan.t)]
            if ARRAY in config:
                values = np.array(scan.counts)[skin.taxel >= 0].tolist()
                items = [ArrayFrame(scan.t, "a", 0, tuple(values))]
            for k in range(links):
                for item in items:
                    recorder.take(item, k)
            recorder.take(Pass(scan.t))
            declared = []
    (tmp_path / "config.toml").write_text(config, encoding="utf-8")
    assert cli.main(["accept", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.endswith("PASSED\n")
    assert said.count("modules: 4 of 4 felt a press") == links
    assert ("-      temperature" in said) == (ARRAY in config)
    line = ["accept", str(tmp_path), "--layout"]
    if of_another:
        assert cli.main([*line, LAYOUT.replace("20", "30")]) == 1
        assert of_another in " ".join(capsys.readouterr().out.split())
        assert "nothing.json" in refused(*line, "nothing.json", main=cli.main)
    else:
        assert "there are several links" in refused(*line, LAYOUT, main=cli.main)
