"""Which taxel is which, where no DECLARE was heard: as listed, as told later, or refused."""

import itertools
import shutil
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import pytest

from taxeld.commands.record import Recording
from taxeld.commands.replay import RecordedInputs, open_pipeline
from taxeld.config.file import load, parse
from taxeld.config.tables import SourceConfig
from taxeld.source import modules, session
from taxeld.source.sources import LiveSource
from taxeld_hil.rig.virtual_ihb import Phase, VirtualIhb
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame
from taxeld_protocol.modules import Module, listed
from tests.rig import skins
from tests.rig.commands import printed, refused, refuses
from tests.rig.configurations import QUIET, configuration
from tests.rig.given_device import GivenDevice
from tests.rig.sessions import write
from tests.rig.skins import SKIN
from tests.rig.virtual_hub import VirtualHub, frames_of, told

# a hub's own order, each module with taxels that the layout does not have
MODULES = listed((module.sui or 0, 0xFFF) for module in reversed(skins.MODULES))
MISSING = "streams, but its answers to DECLARE and MODULE_DETAILS were not heard"
GROUPED = [replace(MODULES[0], grouping=2), *MODULES[1:]]
REFUSED = f"hub 1 is refused: module {MODULES[0].sui} is grouped (grouping 2)"

Listed = tuple[tuple[int, ...], ...]


def pairs(of: Iterable[Module], *hub: int) -> Listed:
    return tuple((module.sui or 0, module.mask, *hub) for module in of)


def hub(of: list[Module] = MODULES, short_id: int = 1) -> VirtualIhb:
    return VirtualIhb(of, short_id=short_id)


def tells(of: VirtualIhb, *without: int) -> list[Frame]:
    """What it answers to DECLARE and MODULE_DETAILS, but for some of the answers."""
    answers = [answer for i, answer in enumerate(told(of)) if i not in without]
    return frames_of(answers, of.short_id, 1.0)


def scan(of: VirtualIhb, t: float = 1.0) -> list[Frame]:
    """In which every channel reads the UID of its taxel."""
    uids = [uid for module in of.modules for uid in module.uids]
    return frames_of(of.sensor_data(uids), of.short_id, t)


ONE, TWO, SEVEN = hub(), hub(short_id=2), hub(MODULES[3:], 7)
FIRST, ODD = hub(MODULES[:3]), hub(GROUPED)
# what is listed, and in turns: what is heard, the hubs that are read, what is waited for
LISTENING: dict[str, tuple[Listed, list[tuple[list[Frame], list[int], str]]]] = {
    "in the order of the list": (pairs(MODULES), [(scan(ONE), [1], "")]),
    "it was there before the skin was started": ((), [(tells(ONE) + scan(ONE), [1], "")]),
    "a list without hubs is of one hub and not of the next": (
        pairs(MODULES),
        [(scan(ONE) + scan(TWO), [1], "")],
    ),
    "each module is listed with its hub": (
        pairs(MODULES[3:], 7) + pairs(MODULES[:3], 1),
        [(scan(FIRST) + scan(SEVEN), [1, 7], "")],
    ),
    "a grouped module": ((), [(tells(ODD) + scan(ODD), [], REFUSED)]),
    "without a list nothing is read until its host has asked": (
        (),
        [
            *((scan(ONE, t), [], f"source.modules: hub 1 {MISSING}") for t in (0.0, 0.05)),
            (tells(ONE) + scan(ONE, 0.1), [1], ""),
        ],
    ),
    "a module that told nothing of itself costs its own taxels alone": (
        (),
        [(tells(ONE, 2), [], ""), *((scan(ONE, 0.05 * k), [1], "") for k in range(100))],
    ),
    "a stranger's packets do not end one that hears its skin": (
        (),
        [
            (tells(ONE), [], ""),
            *((scan(ONE, 0.05 * k) + scan(TWO, 0.05 * k), [1], "") for k in range(100)),
        ],
    ),
}


@pytest.mark.parametrize(("entries", "turns"), LISTENING.values(), ids=LISTENING.keys())
def test_a_listener_reads_the_hubs_whose_modules_it_knows(
    entries: Listed, turns: list[tuple[list[Frame], list[int], str]]
) -> None:
    config = SourceConfig(kind="can", channel="x", listen_only=True, modules=entries)
    device = GivenDevice()
    source = LiveSource(config, {0: SKIN}, lambda _: device)
    for heard, read, waits in turns:
        device.frames = heard
        scans = source.poll(0.0)
        assert [scan.ihb for scan in scans] == read
        for one in scans:
            uids = [uid for module in one.table for uid in module.uids]
            assert all(uid in (count, -1) for uid, count in zip(uids, one.counts, strict=True))
            assert uids.count(-1) in (0, 12)
        assert source.waits_for.startswith(waits)
        assert bool(source.waits_for) is bool(waits)
    assert device.sent == []


def test_a_list_of_another_skin_is_refused() -> None:
    config = SourceConfig("can", channel="x", listen_only=True, modules=((3535, 0xFFF),))
    refuses(
        r"^source\.modules: none of its 1 modules is in [^\n]+$",
        LiveSource,
        config,
        {0: SKIN},
        lambda _: GivenDevice(),
    )


def heard_in(
    place: Path, *heard: Sequence[Frame], listed: Sequence[Sequence[int]] = (), **source: object
) -> list[Scan]:
    """The scans in a session of what was heard, with a list in its head, and keys of its source."""
    shutil.rmtree(place, ignore_errors=True)
    modules_of = {0: tuple(map(tuple, listed))} if listed else None
    write(place, chain.from_iterable(heard), modules=modules_of)
    config = load(configuration(place, source=QUIET | source))
    inputs = RecordedInputs(place, open_pipeline(place, config))
    for arrival in session.arrivals(place):
        inputs.take(arrival)
    return inputs.scans()


def test_a_session_that_does_not_tell_its_modules_is_read_by_a_list_or_refused(
    tmp_path: Path,
) -> None:
    place = tmp_path / "session"
    assert heard_in(place, scan(ONE)) == []
    said = refused("replay", place)
    assert said.startswith(f"source.modules: hub 1 of {place} {MISSING}")
    heard_in(place, tells(ONE, 2), *(scan(ONE, 1.0 + 0.05 * k) for k in range(2)))
    assert printed("replay", place), "one module that told nothing of itself"


@pytest.mark.parametrize("beside", ["config.toml", "head"])
def test_a_session_is_read_by_the_list_of_its_configuration_or_of_its_recorder(
    tmp_path: Path, beside: str
) -> None:
    """A skin of 13 modules, one of them cut: with full modules a quarter of the values is wrong."""
    cut = listed((sui, 0x76D if sui == 7 else 0xFFF) for sui in range(1, 14))
    is_head = beside == "head"
    known = {"listed": pairs(cut)} if is_head else {"listen_only": True, "modules": pairs(cut)}
    [heard] = heard_in(tmp_path / "session", scan(VirtualIhb(cut)), **known)  # type: ignore[arg-type]
    assert heard.by_module == [module.uids for module in cut]


def test_a_hub_whose_modules_only_another_hub_has_told_is_left_out(tmp_path: Path) -> None:
    heard = heard_in(tmp_path, tells(TWO), *[scan(ONE), scan(TWO)] * 2, listen_only=True)
    assert [scan.ihb for scan in heard] == [2, 2]


def test_check_tells_a_listener_without_a_list_when_it_must_be_started(tmp_path: Path) -> None:
    with VirtualHub(tmp_path / "skin", MODULES) as skin:
        for entries in ((), pairs(MODULES)):
            source = skin.source | {"listen_only": True, "modules": entries}
            said = printed("check", configuration(tmp_path, source=source))
            assert ("note: source.modules: lists none" in said) is not bool(entries)


def pasted(path: Path) -> SourceConfig:
    text = path.read_text(encoding="utf-8")
    return parse(f'[source]\nkind = "can"\nchannel = "x"\n{text}[scene]\n').source


def test_what_is_written_for_a_listener_can_be_pasted_and_is_written_through_no_link(
    tmp_path: Path,
) -> None:
    for name, tables in (("one", {1: MODULES}), ("two", {1: MODULES[:2], 5: MODULES[2:]})):
        modules.write(tmp_path / name, tables)
        known = modules.known(pasted(tmp_path / name).modules)
        assert {ihb: known(ihb) for ihb in tables} == tables
    (tmp_path / modules.FILE).symlink_to(tmp_path / "victim")
    with pytest.raises(FileExistsError):
        modules.write(tmp_path / modules.FILE, {1: MODULES})
    assert not (tmp_path / "victim").exists()


@pytest.mark.parametrize(
    ("of", "is_told", "logged"),
    [
        (MODULES, True, ""),
        (GROUPED, True, REFUSED),
        (MODULES, False, f"source.modules: hub 1 {MISSING}"),
    ],
    ids=["told", "refused", "untold"],
)
def test_an_exported_recording_lists_the_modules_for_a_listener_where_they_were_told(
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    of: list[Module],
    is_told: bool,
    logged: str,
) -> None:
    """It goes on where nobody told their order."""
    polls = itertools.count()
    with VirtualHub(tmp_path / "skin", of) as skin:
        if not is_told:
            skin.ihb.phase, skin.ihb.auto_sync = Phase.RUNNING, True
        file = configuration(tmp_path, source=skin.source | {"listen_only": not is_told})
        recording = Recording(load(file), file, tmp_path / "session")

        def ends() -> bool:
            skin.serve(time.monotonic(), lambda _: [u for m in MODULES for u in m.uids])
            return skin.ihb.phase == Phase.RUNNING and next(polls) > 500

        recording.run(ends)
    assert [text[: len(logged)] for text in caplog.messages[-1:]] == [logged] * bool(logged)
    printed("export", tmp_path / "session", "--out", tmp_path / "out")
    written = tmp_path / "out" / modules.FILE
    assert written.exists() is bool(recording.scans) is (not logged)
    assert not written.exists() or pasted(written).modules == pairs(MODULES)
