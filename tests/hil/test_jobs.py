"""Jobs of an experiment: remembered, whole, in time, on one machine or on a cluster."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from taxeld.errors import SetupError
from taxeld_sim import jobs
from taxeld_sim.jobs import Job


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
    beside = Job("job", note, (), (place, 0))
    assert jobs.run([beside], tmp_path / "memory")["job"]["square"] == 0
    long = Job(f"{'/a' * 200}, seed 0", json.loads, ("[1]",))  # its name fits a file's
    assert jobs.run([long], tmp_path) == {long.name: [1]}


def test_a_worker_that_dies_and_a_memory_that_cannot_be_written_are_refused_in_one_line(
    tmp_path: Path,
) -> None:
    dead = [Job(f"dead-{i}", die, ("", 3)) for i in range(2)]
    with pytest.raises(SetupError, match="a worker process died"):
        jobs.run(dead, tmp_path / "memory")
    (tmp_path / "file").touch()
    with pytest.raises(SetupError, match=f"--memory: {tmp_path / 'file'}: "):
        jobs.run(dead, tmp_path / "file")
    (tmp_path / "memory" / f"{three(tmp_path)[0].key}.part").mkdir()
    with pytest.raises(SetupError, match=f"--memory: {tmp_path / 'memory'}: .*name a directory"):
        jobs.run(three(tmp_path)[:1], tmp_path / "memory")
    with pytest.raises(SetupError, match="--workers must be at least 1"):
        jobs.run(dead, tmp_path / "memory", workers=0)


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
            assert long.stdout is not None
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
    with pytest.raises(SetupError, match=r"--workers: no scheduler answers at tcp://127.0.0.1:9"):
        jobs.run(three(tmp_path), tmp_path / "other", workers="tcp://127.0.0.1:9")


def test_layouts_have_rows_in_turn_and_two_of_one_name_are_refused(tmp_path: Path) -> None:
    line, here = "wrap:modules=12,radius_m=0.04", tmp_path / "here.csv"
    assert jobs.layouts(None) == [""]
    assert jobs.layouts(["own", line, str(here), str(here)]) == ["", line, str(here)]
    assert [jobs.layout_name(each) for each in ("", line, str(here))] == ["", line, "here"]
    with pytest.raises(SetupError, match="two are called here"):
        jobs.layouts([str(here), str(tmp_path / "here.json")])
