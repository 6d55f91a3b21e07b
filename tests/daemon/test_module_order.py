"""Which taxel is which, where no DECLARE was heard: as listed, as told elsewhere, or refused."""

import itertools
import json
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from taxeld.commands.record import Recording
from taxeld.config.file import load, parse
from taxeld.config.tables import SourceConfig
from taxeld.errors import SetupError
from taxeld.source import modules
from taxeld.source.sources import LiveSource
from taxeld_hil.rig.virtual_ihb import Answer, Phase, VirtualIhb
from taxeld_protocol.decoder import Scan
from taxeld_protocol.frames import Frame, format_log_line
from taxeld_protocol.modules import Module, listed
from tests.rig import skins
from tests.rig.commands import printed, refused
from tests.rig.configurations import QUIET, configuration
from tests.rig.given_device import GivenDevice
from tests.rig.skins import SKIN
from tests.rig.virtual_hub import VirtualHub, frames_of, told

# a hub's own order, each module with taxels that the layout does not have
MODULES = listed((module.sui or 0, 0xFFF) for module in reversed(skins.MODULES))
LISTED = tuple((module.sui or 0, module.mask) for module in MODULES)
UIDS = [uid for module in MODULES for uid in module.uids]
MISSING = "DECLARE and MODULE_DETAILS were not heard"


def frames(hub: VirtualIhb, answers: Iterable[Answer], t: float = 1.0) -> list[Frame]:
    return frames_of(answers, hub.short_id, t)


def scan(hub: VirtualIhb, t: float = 1.0) -> list[Frame]:
    """In which every channel reads the UID of its taxel."""
    return frames(hub, hub.sensor_data([u for m in hub.modules for u in m.uids]), t)


def log(place: Path, heard: Sequence[Frame]) -> Path:
    path = place / "frames.log"
    path.write_text("\n".join(map(format_log_line, heard)) + "\n", encoding="ascii")
    return path


def configured(place: Path, **source: object) -> str:
    """The configuration beside what was logged in `place`."""
    return str(configuration(place, source=QUIET | source))


def is_right(scans: Sequence[Scan]) -> bool:
    """Whether each taxel read its own UID."""
    return all(
        uid == count
        for scan in scans
        for uid, count in zip([u for m in scan.table for u in m.uids], scan.counts, strict=True)
    )


def listener(modules: tuple[tuple[int, ...], ...] = ()) -> tuple[LiveSource, GivenDevice]:
    config = SourceConfig(kind="can", channel="x", listen_only=True, modules=modules)
    device = GivenDevice()
    return LiveSource(config, {0: SKIN}, lambda _: device), device


GROUPED = [replace(MODULES[0], grouping=2), *MODULES[1:]]
REFUSED = f"hub 1 is refused: module {MODULES[0].sui} is grouped (grouping 2)"
FIRST, SECOND = MODULES[:3], MODULES[3:]


@pytest.mark.parametrize(
    ("modules", "hubs", "tells", "read", "waits"),
    [
        (LISTED, [(MODULES, 1)], False, [1], ""),
        ((), [(MODULES, 1)], True, [1], ""),
        (LISTED, [(MODULES, 1), (MODULES, 2)], False, [1], ""),
        (
            tuple((m.sui, m.mask, ihb) for ihb, ms in ((7, SECOND), (1, FIRST)) for m in ms),
            [(FIRST, 1), (SECOND, 7)],
            False,
            [1, 7],
            "",
        ),
        ((), [(GROUPED, 1)], True, [], REFUSED),
    ],
    ids=[
        "in the order of the list",
        "it was there before the skin was started",
        "a list without hubs is of one hub and not of the next",
        "each module is listed with its hub",
        "a grouped module",
    ],
)
def test_a_listener_reads_the_hubs_whose_modules_it_knows(
    modules: tuple[tuple[int, ...], ...],
    hubs: list[tuple[list[Module], int]],
    tells: bool,
    read: list[int],
    waits: str,
) -> None:
    source, device = listener(modules)
    for hub in (VirtualIhb(own, short_id=ihb) for own, ihb in hubs):
        device.frames += (frames(hub, told(hub)) if tells else []) + scan(hub)
    scans = source.poll(0.0)
    assert [scan.ihb for scan in scans] == read
    assert is_right(scans)
    assert source.waits_for.startswith(waits)
    assert bool(source.waits_for) is bool(waits)


def test_a_listener_without_a_list_decodes_nothing_and_says_what_is_missing() -> None:
    source, device = listener()
    hub = VirtualIhb(MODULES)
    for now in (0.0, 0.05):
        device.frames = scan(hub, now)
        assert source.poll(now) == []
    for part in (MISSING, "source.modules: hub 1 streams", "taxeld record"):
        assert part in source.waits_for
    device.frames = frames(hub, told(hub)) + scan(hub, 0.1)  # its host has asked at last
    assert len(source.poll(0.1)) == 1
    assert source.waits_for == ""


def test_a_module_that_told_nothing_of_itself_costs_its_own_taxels_alone(tmp_path: Path) -> None:
    hub = VirtualIhb(MODULES)
    declare, first, _, *rest = told(hub)  # the second module's details are lost
    answers = frames(hub, [declare, first, *rest])
    source, device = listener()
    heard = [scan(hub, 0.05 * k) for k in range(100)]
    device.frames = answers
    for k, frames_of_scan in enumerate(heard):
        device.frames += frames_of_scan
        [got] = source.poll(0.05 * k)
        assert source.waits_for == ""
    assert [module.sui for module in got.table] == [
        None if i == 1 else module.sui for i, module in enumerate(MODULES)
    ]
    log(tmp_path, [*answers, *heard[0]])
    configured(tmp_path)
    assert printed("replay", tmp_path)


def test_a_strange_packet_does_not_end_a_listener_that_hears_its_skin() -> None:
    source, device = listener()
    hub, stranger = VirtualIhb(MODULES), VirtualIhb(MODULES, short_id=9)
    device.frames = frames(hub, told(hub))
    for k in range(100):
        device.frames += scan(hub, 0.05 * k) + scan(stranger, 0.05 * k)
        source.poll(0.05 * k)
        assert source.waits_for == ""
    assert source.decoder.stats()["undeclared"] == 100  # packets of the stranger's


def test_a_list_of_another_skin_is_refused() -> None:
    with pytest.raises(SetupError, match=r"^source\.modules: none of its 1 modules is in [^\n]+$"):
        listener(((3535, 0xFFF),))


def test_a_log_that_does_not_tell_its_modules_is_read_by_the_configurations_list_or_refused(
    tmp_path: Path,
) -> None:
    path = log(tmp_path, scan(VirtualIhb(MODULES)))
    decode = ["decode", path, "--config", configured(tmp_path)]
    for command, place in ((decode, path), (["replay", tmp_path], tmp_path)):
        said = refused(*command)
        assert said.startswith(f"source.modules: hub 1 of {place} streams")
        assert MISSING in said
    configured(tmp_path, modules=LISTED)
    heard = json.loads(printed(*decode).splitlines()[0])
    assert heard["modules"] == [m.uids for m in MODULES]


@pytest.mark.parametrize("beside", ["config.toml", modules.FILE])
def test_decode_of_a_sessions_log_reads_by_the_list_beside_it(tmp_path: Path, beside: str) -> None:
    """A skin of 13 modules, one of them cut: with full modules a quarter of the values is wrong."""
    cut = listed((sui, 0x76D if sui == 7 else 0xFFF) for sui in range(1, 14))
    path = log(tmp_path, scan(VirtualIhb(cut)))
    if beside == "config.toml":
        pairs = [(module.sui, module.mask) for module in cut]
        configuration(tmp_path, source=QUIET | {"listen_only": True, "modules": pairs})
    else:
        modules.write(tmp_path / beside, {1: cut})
    heard, last = map(json.loads, printed("decode", path).splitlines())
    assert heard["modules"] == [module.uids for module in cut]
    assert last["stats"]["scans"] == 1


def test_decode_leaves_out_a_hub_whose_modules_only_another_hub_has_told(tmp_path: Path) -> None:
    quiet, telling = VirtualIhb(MODULES, short_id=1), VirtualIhb(MODULES, short_id=2)
    answers = frames(telling, told(telling))
    path = log(tmp_path, [*answers, *2 * (scan(quiet) + scan(telling))])
    configuration(tmp_path, source=QUIET | {"listen_only": True})
    *heard, last = map(json.loads, printed("decode", path).splitlines())
    assert [scan["ihb"] for scan in heard] == [2, 2]
    assert last["stats"]["undeclared"] > 0


def test_check_tells_a_listener_without_a_list_when_it_must_be_started(tmp_path: Path) -> None:
    with VirtualHub(tmp_path / "skin", MODULES) as hub:
        source, noted = hub.source | {"listen_only": True}, "note: source.modules: lists none"
        assert noted in printed("check", configuration(tmp_path, source=source))
        listed_too = configuration(tmp_path, source=source | {"modules": LISTED})
        assert noted not in printed("check", listed_too)


def pasted(path: Path) -> SourceConfig:
    text = path.read_text(encoding="utf-8")
    return parse(f'[source]\nkind = "can"\nchannel = "x"\n{text}[scene]\n').source


def test_what_is_written_for_a_listener_can_be_pasted(tmp_path: Path) -> None:
    for name, tables in (("one", {1: MODULES}), ("two", {1: MODULES[:2], 5: MODULES[2:]})):
        modules.write(tmp_path / name, tables)
        given = modules.given(pasted(tmp_path / name), SKIN)
        assert {ihb: given.of(ihb) for ihb in tables} == tables


def test_a_list_of_modules_is_written_over_nothing_and_through_no_link(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    (tmp_path / modules.FILE).symlink_to(victim)
    with pytest.raises(FileExistsError):
        modules.write(tmp_path / modules.FILE, {1: MODULES})
    assert not victim.exists()


def recorded(place: Path, hub: VirtualHub, **source: Any) -> tuple[str, Recording]:
    """The last line of a recording of some scans, or of much else that the hub said."""
    file = configuration(place, source=hub.source | source)
    recording, polls = Recording(load(file), file, place / "session"), itertools.count()

    def ends() -> bool:
        hub.serve(time.monotonic(), lambda _: UIDS)
        return hub.ihb.phase == Phase.RUNNING and next(polls) > 500

    return recording.run(ends), recording


def test_a_recording_lists_the_modules_for_a_listener_or_says_why_it_does_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """And goes on where nobody told their order."""
    for name in ("told", "refused", "untold"):
        place, modules_ = tmp_path / name, GROUPED if name == "refused" else MODULES
        place.mkdir()
        with VirtualHub(place / "skin", modules_) as hub:
            if name == "untold":
                hub.ihb.phase, hub.ihb.auto_sync = Phase.RUNNING, True
            line, recording = recorded(place, hub, listen_only=name == "untold")
        written = place / "session" / modules.FILE
        if name == "told":
            assert f"{written}, for source.modules" in line
            assert pasted(written).modules == LISTED
            assert not caplog.messages
            continue
        assert recording.scans == 0
        assert (REFUSED if name == "refused" else "to replay it, list source.modules") in line
        assert not written.exists()
    assert caplog.messages[-1].startswith("source.modules: hub 1 streams")
