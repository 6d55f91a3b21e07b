"""The injector does its faults and no more; the ledger and the judge find what is wrong."""

import math
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest

from taxeld.errors import SetupError
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import Why
from taxeld.stream import topics
from taxeld_hil.grade import flags
from taxeld_hil.grade.grade import Grade, grade, lines
from taxeld_hil.grade.reconcile import laws
from taxeld_hil.grade.session import PUBLISHED, Run, add, read, read_run
from taxeld_hil.rig.faults import Injector
from taxeld_hil.rig.ledger import Ledger, Sent, WireUnit
from taxeld_hil.rig.rig import Rig
from taxeld_hil.run.fake import FakeRun
from taxeld_hil.run.session_run import write_truth
from taxeld_hil.scenario import scenario
from taxeld_hil.scenario.scenario import Fault, Scenario
from taxeld_protocol import cyskin
from taxeld_protocol.cyskin import Command
from taxeld_protocol.frames import Frame
from tests.hil.rig import TRUTH
from tests.rig.stream_page import documented

pytestmark = pytest.mark.check

DEMO = scenario.load("demo").on("scene")
MODULES = (3, 3)
CHANNELS = [range(1, 3), range(4, 6)]
TAXELS = {0: 1, 1: 2, 2: 4, 3: 5}
WIDE = "cylinder:rows=8,columns=16,radius_m=0.04,pitch_m=0.015"  # two packets a scan


def injector(*faults: Fault) -> tuple[Injector, Ledger]:
    ledger = Ledger(MODULES, 0.05)
    return Injector(faults, 0, ledger, CHANNELS, TAXELS), ledger


def units(number: int) -> list[WireUnit]:
    data = cyskin.encode(Command.SENSOR_DATA, bytes(14))
    sent = Sent(data, Command.SENSOR_DATA, 3, 0, 6)
    return [
        WireUnit(frame, sent, part)
        for _ in range(number)
        for part, frame in enumerate(cyskin.fragment(data, 1))
    ]


@pytest.mark.parametrize("kind", ["dropped", "duplicated", "reordered", "corrupted", "late"])
def test_frames_are_changed_during_a_fault_alone_and_each_change_is_counted(kind: str) -> None:
    subject, ledger = injector(Fault(kind, at_s=1.0, for_s=1.0, share=0.3, delay_s=0.0))
    before, sent = ledger.done[kind], units(100)
    assert [out for unit in sent for out in subject.unit(unit, 0.5)] == sent
    assert ledger.done[kind] == before == 0
    out = [out for unit in sent for out in subject.unit(unit, 1.5)] + subject.flush()
    done = ledger.done[kind]
    assert 50 < done < 130
    change = {"dropped": -done, "duplicated": done}.get(kind, 0)
    assert len(out) == len(sent) + change
    damaged = sum(unit not in sent for unit in out)
    assert damaged == (done if kind == "corrupted" else 0)
    assert [out for unit in sent for out in subject.unit(unit, 2.0)] == sent


def test_counts_of_the_named_taxels_change_and_no_others() -> None:
    counts = [10, 20, 30, 40, 50, 60]
    for fault, expected in (
        (Fault("saturated", 0.0, taxels=(2,)), [10, 20, 30, 40, 0xFFFF, 60]),
        (Fault("module_dead", 0.0, module=1), [10, 20, 30, None, None, None]),
        (Fault("baseline_jump", 0.0, module=0, counts=5.0), [10, 25, 35, 40, 50, 60]),
    ):
        subject, _ = injector(fault)
        assert subject.counts(list(counts), 0.5) == expected
        assert subject.counts(list(counts), 2.0) == counts
    subject, _ = injector(Fault("taxel_stuck", 1.0, 1.0, taxels=(0,)))
    read = [subject.counts([0, 100 + k, 0, 0, 0, 0], 0.5 * k)[1] for k in range(6)]
    assert read == [100, 101, 102, 102, 104, 105], "what it read when it stuck"


def test_a_flooded_bus_has_so_many_foreign_frames_a_second() -> None:
    subject, ledger = injector(Fault("flooded", 1.0, 2.0, per_s=300.0))
    flood = [unit for k in range(500) for unit in subject.due(0.01 * k, line=False)]
    assert len(flood) == ledger.done["flooded"] == pytest.approx(600, abs=4)
    for unit in flood:
        ledger.deliver(unit, 0.0)
    assert ledger.fates.foreign == len(flood)


def test_poses_freeze_jump_are_late_or_missing_as_the_fault_says() -> None:
    def published(fault: Fault) -> list[tuple[float, ...]]:
        subject, _ = injector(fault)
        rows = [(0.1 * k, float(k), 0.0, 0.0) for k in range(30)]
        return [out for row in rows for out in subject.poses(row, row[0])]

    frozen = published(Fault("pose_frozen", 1.0, 1.0))
    assert [row[1] for row in frozen[10:20]] == [10.0] * 10
    assert [row[0] for row in frozen] == [0.1 * k for k in range(30)]
    assert len(published(Fault("pose_silent", 1.0, 1.0))) == 20
    jumped = published(Fault("pose_jumping", 1.0, 1.0, share=1.0, offset_m=2.0))
    assert [row[1] for row in jumped[10:20]] == [k + 2.0 for k in range(10, 20)]
    late = published(Fault("pose_late", 1.0, 1.0, delay_s=0.5))
    assert sorted(late) == [(0.1 * k, float(k), 0.0, 0.0) for k in range(30)]
    assert late != sorted(late)


def test_a_counter_of_the_daemon_that_is_off_by_one_breaks_a_law(tmp_path: Path) -> None:
    FakeRun(replace(DEMO, contacts=2), seed=0).graded("demo", tmp_path)
    ledger, (_, health) = read_run(tmp_path).ledger, read(tmp_path, 1).health[-1]
    assert ledger is not None
    assert all(law.holds for law in laws(ledger, health, line=False))
    for part, name in (("source", "crc_errors"), ("skin", "learning"), ("inputs", "poses")):
        worse = {**health, part: {**health[part], name: health[part][name] + 1}}
        held = laws(ledger, worse, line=False)
        assert any(not law.holds for law in held), name


def judged(
    place: Path,
    estimates: list[tuple[float, Status, float]],
    *faults: Fault,
    of: Scenario = DEMO,
    **more: object,
) -> Grade:
    """The grade of a session of estimates (t, status, error in m) beside faults; `more` is the same
    in all estimates."""
    (_, example), end_s = documented("/taxeld/estimate"), max([0.0, *(e[0] for e in estimates)])
    with (place / PUBLISHED).open("wb") as file:
        for t, status, off_m in estimates:
            said = {
                "status": status,
                "why": Why.NO_SCAN if status is Status.STALE else Why.VALID,
                "p": 0.98 if status is Status.AMBIGUOUS else 0.99,
                "radius_m": 0.005,
                "map": {"x": TRUTH[0] + off_m, "y": TRUTH[1], "theta": TRUTH[2]},
                "object": 0,
            }
            add(file, t, topics.ESTIMATE, msgpack.packb(example | said | more))
    write_truth(place, TRUTH)
    Run("x", 0, "fake", replace(of, fault=faults), end_s, [()] * len(faults)).write(place)
    return grade(place)


def test_what_misleads_a_late_flag_and_a_slow_recovery_are_found(tmp_path: Path) -> None:
    fault = Fault("unplugged", at_s=1.0, for_s=1.0)
    good, stale = (Status.CONVERGED, 0.0), (Status.STALE, 0.0)
    times = np.arange(0.0, 6.0, 0.01).tolist()
    fine = [(t, *(stale if 1.5 < t < 2.4 else good)) for t in times]
    worse = [
        (t, *((Status.CONVERGED, 0.05) if t > 5.5 else stale if 1.9 < t < 4.5 else good))
        for t in times
    ]
    assert judged(tmp_path, fine, fault).failed == []
    graded = judged(tmp_path, worse, fault)
    assert graded.failed == [
        "accuracy",
        "nothing misleading",
        "unplugged at 1 s: flag",
        "unplugged at 1 s: recovery",
    ]
    assert graded.figures["misleading"]["episodes"] == 1


def test_valid_estimates_that_are_sure_and_beyond_their_radius_mislead(tmp_path: Path) -> None:
    sure, doubted, stale = Status.CONVERGED, Status.AMBIGUOUS, Status.STALE
    said = [(sure, 0.004), (sure, 0.006), (doubted, 0.006), (stale, 0.006), (sure, 0.004)]
    graded = judged(tmp_path, [(0.1 * k, *each) for k, each in enumerate(said)])
    assert (graded.figures["sure"], graded.figures["misleading"]["estimates"]) == (3, 1)
    assert graded.figures["misleading"]["at_s"] == [0.1]
    (line,) = (line for line in lines(graded) if "nothing misleading" in line)
    assert line.endswith("1 of 3 sure estimates, 6.0 mm off at worst")


def test_a_daemon_that_publishes_nothing_fails_and_a_damaged_run_is_refused_with_its_file(
    tmp_path: Path,
) -> None:
    silent = judged(tmp_path, [])
    assert silent.failed == ["object found", "accuracy"]
    assert silent.checks[0].detail == "no estimate came"
    judged(tmp_path, [(0.0, Status.CONVERGED, 0.0)])
    for name, content in (("published.msgpack", b"\xc1"), ("run.json", b"{")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SetupError, match=f"^{tmp_path / name}: "):
            grade(tmp_path)


def test_a_counter_that_grows_raises_the_flag_and_one_from_before_a_restart_does_not() -> None:
    flag = flags.flag_of(Fault("corrupted", 1.0), "slcan")
    assert flag is not None
    before = {"uptime_s": 9.0, "source": {"crc_errors": 4, "length_errors": 0}}
    assert not flags.grew(flag, before, before | {"uptime_s": 10.0})
    assert flags.grew(flag, before, {"uptime_s": 10.0, "source": {"crc_errors": 5}})
    assert not flags.grew(flag, before, {"uptime_s": 1.0, "source": {"crc_errors": 0}})
    assert flags.grew(flag, before, {"uptime_s": 1.0, "source": {"crc_errors": 1}})


def test_faults_of_a_scenario_are_named_by_their_place(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('bundle = "box"\n[[fault]]\nkind = "flood"\nat_s = 1\nshare = 2.0\n')
    with pytest.raises(SetupError) as caught:
        scenario.load(str(path))
    assert str(caught.value).splitlines() == [
        f"fault[0].kind: must be one of {', '.join(scenario.KINDS)}, not 'flood'",
        "fault[0].share: must be 0..1, not 2",
    ]
    for wrong, expected in (
        ("module = 8", "module: the skin has 0..7"),
        ("taxels = [80]", "0..79"),
    ):
        path.write_text(f'bundle = "box"\n[[fault]]\nkind = "saturated"\nat_s = 1\n{wrong}\n')
        with pytest.raises(SetupError, match=expected):
            FakeRun(scenario.load(str(path)), 0)
    path.write_text('bundle = "box"\nfault = 3\n')
    with pytest.raises(SetupError, match=r"^fault: must be a list of tables \(\[\[fault\]\] in T"):
        scenario.load(str(path))


def test_poses_go_on_when_the_wall_clock_is_set_back() -> None:
    rig = Rig(DEMO, 0)
    stamps = [
        row[0]
        for k in range(100)
        for row in rig.poses(0.01 * k, 50.0 + 0.01 * k, 1e9 + 0.01 * k - 3600.0 * (k >= 50))
    ]
    assert len(stamps) >= 98
    assert stamps[-1] < 1e9 - 3500.0


@pytest.mark.parametrize("loses", [False, True])
def test_a_host_that_reads_a_scan_in_two_parts_keeps_the_laws_and_one_that_loses_a_packet_does_not(
    loses: bool,
) -> None:
    run = FakeRun(replace(DEMO, contacts=2).on("", WIDE), seed=0)
    run.rig.ledger.period_s = math.inf  # as in real time
    take, rng = run.line.take, np.random.default_rng(0)
    waiting: list[Frame] = []
    lost: list[Frame] = []

    def busy() -> list[Frame]:
        came, t = take(), run.line.t
        if loses and t > 2.0 and not lost and came:  # the second packet of a scan
            lost.extend(came[cyskin.MAX_FRAGMENTS :])  # type: ignore[arg-type]
            came = came[: cyskin.MAX_FRAGMENTS]
        waiting.extend(came)  # type: ignore[arg-type]
        read = rng.integers(100) * (rng.random() < 0.2) if t < run.duration_s - 1.0 else 100
        now, waiting[:read] = waiting[:read], []
        return [frame._replace(t=run.line.now) for frame in now]

    run.line.take = busy  # type: ignore[method-assign]
    graded = run.graded("demo")
    held = {law["name"]: law for law in graded.figures["laws"]}
    broken = {name for name, law in held.items() if not law["holds"]}
    assert held["scans incomplete"]["counted"] > 10, "scans were read in parts"
    assert broken >= {"frames", "packets whole", "scans incomplete"} if loses else not broken
    assert {f"accounts: {name}" for name in broken} <= {*graded.failed}
