"""Jobs of an experiment: remembered, whole, in time, on one machine or on a cluster."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
from importlib import resources
from itertools import pairwise
from pathlib import Path

import pytest

from taxeld.estimator.estimate import SURE
from taxeld.layout import read as layouts
from taxeld_hil import cli
from taxeld_hil.experiment import runs
from taxeld_hil.scenario import random_faults
from taxeld_hil.scenario.scenario import Scenario
from taxeld_sim import integrity, jobs
from taxeld_sim.jobs import Job
from taxeld_sim.trials import case
from tests.hil.rig import DEMO, SKIN
from tests.rig.commands import refuses
from tests.rig.skins import table_of


def note(place: str, value: int) -> dict[str, int]:
    """Leave a mark for every time it runs, and say with how many threads it may."""
    with (Path(place) / f"ran-{value}").open("a", encoding="ascii") as file:
        file.write("x")
    return {"square": value * value, "threads": int(os.environ.get("OPENBLAS_NUM_THREADS", "0"))}


def refuse(place: str, value: int) -> None:
    raise ValueError(f"{place} {value}")


def die(_: str, value: int) -> None:
    os._exit(value)


def three(place: Path) -> list[Job]:
    return [Job(f"job-{i}", note, (str(place), i)) for i in range(3)]


def times_run(place: Path) -> list[int]:
    return [len(path.read_text(encoding="ascii")) for path in sorted(place.glob("ran-*"))]


def test_what_has_finished_is_remembered_unless_it_is_torn_and_all_else_is_told_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Even before a failure. A worker has one thread, though this process may have more."""
    for name in jobs.ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    memory, mine = tmp_path / "memory", three(tmp_path)
    jobs.run(mine[:2], memory, workers=2)
    with pytest.raises(ValueError, match="9"):
        jobs.run([*mine, Job("bad", refuse, ("", 9))], memory, workers=1)
    (memory / f"{mine[1].key}.json").write_text('{"squ', encoding="ascii")
    capsys.readouterr()
    found = jobs.run(three(tmp_path), memory, describe=lambda result: f"square {result['square']}")
    assert [found[f"job-{i}"]["square"] for i in range(3)] == [0, 1, 4]
    assert found["job-0"]["threads"] == 1
    remembered, told = capsys.readouterr().err.splitlines()
    assert remembered == f"2 of 3 runs are remembered in {memory}"
    assert re.fullmatch(r"1 of 1, .* s, 0 s left: job-1: square 1", told)
    assert times_run(tmp_path) == [1, 2, 1]


def test_work_arguments_and_code_make_a_job_and_arguments_beside_do_not(tmp_path: Path) -> None:
    place = str(tmp_path)
    same = Job("job", note, (0,), (place,))
    assert same.key == Job("job", note, (0,), ("elsewhere",)).key
    others = [Job("job", note, (1,)), Job("job", refuse, (0,)), Job("job", note, (0,), code="x")]
    assert len({job.key for job in (same, *others)}) == 4
    assert jobs.run([Job("job", note, (), (place, 0))], tmp_path / "memory")["job"]["square"] == 0
    long = Job(f"{'/a' * 200}, seed 0", json.loads, ("[1]",))  # its name fits a file's
    assert jobs.run([long], tmp_path) == {long.name: [1]}


def test_a_worker_that_dies_and_a_memory_that_cannot_be_written_are_refused_in_one_line(
    tmp_path: Path,
) -> None:
    dead = [Job(f"dead-{i}", die, ("", 3)) for i in range(2)]
    refuses("a worker process died", jobs.run, dead, tmp_path / "memory")
    (tmp_path / "file").touch()
    refuses(f"--memory: {tmp_path / 'file'}: ", jobs.run, dead, tmp_path / "file")
    (tmp_path / "memory" / f"{three(tmp_path)[0].key}.part").mkdir()
    refuses(
        f"--memory: {tmp_path / 'memory'}: .*name a directory",
        jobs.run,
        three(tmp_path)[:1],
        tmp_path / "memory",
    )
    refuses("--workers must be at least 1", jobs.run, dead, tmp_path / "memory", workers=0)


LONG = """
import os, sys, time
from pathlib import Path
from taxeld_sim import jobs

def work(*_):
    os.write(1, b"begun ")  # whole, though two write there
    time.sleep(600)

if __name__ == "__main__":
    jobs.run([jobs.Job(name, work, ()) for name in "ab"], Path(sys.argv[1]))
"""


def test_a_killed_command_leaves_no_worker_behind(tmp_path: Path) -> None:
    """Its output ends once no process is left that could write there."""
    (tmp_path / "long.py").write_text(LONG, encoding="ascii")
    command = [sys.executable, str(tmp_path / "long.py"), str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as long:
        try:
            assert long.stdout.read(12) == b"begun begun "
        finally:
            long.kill()
        assert long.communicate(timeout=120.0)[0] == b""


@pytest.mark.filterwarnings("ignore")  # of the cluster's own
def test_the_same_jobs_run_on_a_dask_cluster_and_a_missing_scheduler_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        address = cluster.scheduler_address
        found = jobs.run(three(tmp_path), tmp_path / "memory", workers=address)
    assert [found[f"job-{i}"]["square"] for i in range(3)] == [0, 1, 4]
    assert times_run(tmp_path) == [1, 1, 1]
    monkeypatch.setattr(jobs, "PATIENCE", "300ms")
    refuses(
        r"--workers: no scheduler answers at tcp://127.0.0.1:9",
        jobs.run,
        three(tmp_path),
        tmp_path / "other",
        workers="tcp://127.0.0.1:9",
    )


def test_layouts_have_rows_in_turn_and_two_of_one_name_are_refused(tmp_path: Path) -> None:
    line, here = "wrap:modules=12,radius_m=0.04", tmp_path / "here.csv"
    assert jobs.layouts(None) == [""]
    assert jobs.layouts(["own", line, str(here), str(here)]) == ["", line, str(here)]
    assert [jobs.layout_name(each) for each in ("", line, str(here))] == ["", line, "here"]
    refuses("two are called here", jobs.layouts, [str(here), str(tmp_path / "here.json")])


SMALL = "cylinder:rows=2,columns=20,radius_m=0.04,pitch_m=0.015"  # four modules of ten taxels
SHORT = """\
bundle = "box"
contacts = 3
expect = {found = false}
fault = [{kind = "flooded", at_s = 2.0}]
"""


def test_a_run_of_other_code_or_another_scenario_bundle_or_layout_is_not_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, own = tmp_path / "box", tmp_path / "own.csv"
    shutil.copytree(Path(str(resources.files("taxeld") / "bundles" / "box")), copy)

    def code(subject: Scenario = DEMO) -> str:
        return runs.of("demo", subject, 0).code

    codes = [code(), code(DEMO.on("poor")), code(DEMO.touching(str(copy)))]
    with (copy / "bundle.json").open("a") as file:
        file.write("\n")
    codes.append(code(DEMO.touching(str(copy))))
    for layout in (SKIN, layouts.load("wrap:modules=12,radius_m=0.04")):
        own.write_text(table_of(layout), encoding="ascii")
        codes.append(code(DEMO.on("", str(own))))
    assert code() == codes[0]
    monkeypatch.setattr(case, "code", lambda: "of other code")
    assert len({*codes, code()}) == 7


def test_a_measurement_goes_on_from_what_it_remembers_and_names_the_checks_that_failed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    short = tmp_path / "short.toml"
    short.write_text(SHORT, encoding="utf-8")
    command = ["matrix", str(short), "--foam", "stiff", "--object", "box", "--workers", "1"]
    command += ["--out", str(tmp_path)]
    assert cli.main([*command, "--seeds", "1"]) < 2
    assert "box, stiff, seed 0: " in capsys.readouterr().err
    assert cli.main([*command, "--seeds", "2"]) < 2
    second = capsys.readouterr()
    assert "1 of 2 runs are remembered" in second.err
    assert "seed 0" not in second.err
    rows = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))["runs"]
    assert [row["seed"] for row in rows] == [0, 1]
    assert second.out == f"{sum(row['passed'] for row in rows)} of 2 runs passed\n"
    short.write_text('bundle = "box"\ncontacts = 1\n', encoding="utf-8")
    command[command.index("box")] = "mug"
    assert cli.main([*command, "--seeds", "1"]) == 1
    assert "failed: object found" in capsys.readouterr().err


def test_random_faults_differ_are_determined_by_the_seed_and_leave_time_to_recover() -> None:
    small = DEMO.on("", SMALL)
    made = [random_faults.drawn(small, seed, 1) for seed in range(300)]
    assert made[:30] == [random_faults.drawn(small, seed, 1) for seed in range(30)]
    assert len({repr(one.fault) for one in made}) > 200, "a fifth have no fault"
    for one in made:
        assert all(fault.end_s < other.at_s for fault, other in pairwise(one.fault))
    faults = [fault for one in made for fault in one.fault]
    assert {fault.kind for fault in faults} == {*random_faults.KINDS}
    assert {fault.module for fault in faults} == {0, 1, 2, 3}
    assert 30 < max(taxel for fault in faults for taxel in fault.taxels) < 40
    assert max(fault.end_s for fault in random_faults.drawn(DEMO, 1, 20).fault) > 900.0


@pytest.mark.check
def test_minutes_of_random_faults_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["matrix", "demo", "--foam", "scene", "--object", "box", "--workers", "1"]
    assert cli.main([*command, "--random", "1", "--seeds", "4", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "scenarios.json").read_text(encoding="utf-8"))["runs"]
    assert len(rows) == 4
    assert any(row["faults"] for row in rows)


@pytest.mark.parametrize(
    ("p", "error_mm", "radius_mm", "found", "sure", "misleading"),
    [
        (1.0, 3.0, 5.0, True, True, False),
        (SURE, 5.0, 5.0, True, True, False),  # exactly at its radius
        (1.0, 6.0, 5.0, True, True, True),  # beyond its radius
        (1.0, 10.0, 20.0, False, True, True),  # 10 mm is not under 10 mm
        (1.0, math.nan, 20.0, False, True, True),  # another object
        (0.98, 99.0, 5.0, False, False, False),  # claims nothing
        (math.nan, 99.0, math.nan, False, False, False),  # a filter that publishes no p
    ],
)
def test_what_is_sure_misleads_unless_it_is_found_and_within_its_radius(
    p: float, error_mm: float, radius_mm: float, found: bool, sure: bool, misleading: bool
) -> None:
    assert integrity.is_found(error_mm) == found
    assert integrity.is_sure(p) == sure
    assert integrity.is_misleading(p, error_mm, radius_mm) == misleading
