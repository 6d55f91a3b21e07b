"""Experiments on a Dask cluster: the rows of one machine alone."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import trimesh

from taxeld_training.cli import main
from taxeld_training.filters import cells

distributed = pytest.importorskip("distributed")

EXPERIMENTS = {
    "filter": ("--groups", "table", "--seeds", "2"),
    "proposals": (
        "--groups",
        "analytic",
    ),
}


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    trimesh.creation.box((0.06, 0.1, 0.1)).export(path)
    return path


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


@pytest.mark.filterwarnings("ignore")  # of the cluster's own
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_two_workers_of_a_cluster_give_the_rows_of_one_machine(
    name: str, block: Path, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "BLOCK", 1)  # several jobs
    found = []
    for place, more in (("cluster", ("--dask", address)), ("alone", ("--workers", "1"))):
        out = tmp_path / place
        arguments = ["evaluate", name, "--quick", "--objects", str(block), *EXPERIMENTS[name]]
        places = ["--out", str(out), "--memory", str(out / "memory")]
        assert main([*arguments, *places, *more]) == 0
        found.append(json.loads((out / f"{name}.json").read_text(encoding="utf-8")))
    assert found[0] == found[1]
    assert found[0]
