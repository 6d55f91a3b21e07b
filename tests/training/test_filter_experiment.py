"""The filter experiment, small: rows as the contract has them, and going on after a cut."""

import json
import math
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.estimate import Status
from taxeld.estimator.memory import Slack
from taxeld.estimator.rule import noise_of
from taxeld.model.observation import Noise, Observation, ObservationModel
from taxeld.proposals.analytic import Table
from taxeld_training.cli import main
from taxeld_training.filters import cells, follow, gridded, methods
from taxeld_training.filters import filter as filter_experiment
from taxeld_training.filters.cells import Cell
from taxeld_training.filters.conditions import SILENT, Conditions
from taxeld_training.filters.methods import SHIPPED, Method, TouchResult
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs import fingerprint
from taxeld_training.jobs.options import Options
from taxeld_training.jobs.rows import GRID
from taxeld_training.models.diffusion import Solver
from taxeld_training.objects.setting import Setting, ring
from taxeld_training.samplers import trained, trainings

KEYS = {
    "object", "proposal", "injection", "particles", "contact", "map_mm", "mean_mm", "success_rate",
    "seeds",
}  # fmt: skip
ADDED = {
    "flagged_rate", "silent_failure_rate", "silent_failure_ci", "silent_so_far_rate",
    "silent_so_far_ci", "success_ci", "success_meant_rate", "map_mm_ci", "mean_mm_ci", "p_shipped",
    "particles_mean", "particles_max",
}  # fmt: skip


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    trimesh.creation.box((0.06, 0.1, 0.1)).export(path)
    return path


def command(block: Path, place: Path, *more: str) -> list[str]:
    return [
        "evaluate", "filter", "--quick", "--objects", str(block), "--out", str(place / "out"),
        "--memory", str(place / "memory"), "--seeds", "3", "--workers", "1", *more,
    ]  # fmt: skip


def test_rows_have_the_contracts_keys_and_are_remembered(block: Path, tmp_path: Path) -> None:
    assert main(command(block, tmp_path, "--groups", "table,projection")) == 0
    file = tmp_path / "out" / "filter.json"
    rows = json.loads(file.read_text(encoding="utf-8"))
    methods = {(row["proposal"], row["injection"], row["particles"]) for row in rows}
    assert methods == {
        (proposal, injection, 100)
        for proposal in ("table", "projection")
        for injection in ("mixture", "paper")
    }
    assert len(rows) == 4 * cells.TOUCHES
    for row in rows:
        assert row.keys() == KEYS | ADDED
        assert row["map_mm"]["q10"] <= row["map_mm"]["median"] <= row["map_mm"]["q90"]
        assert row["seeds"] == 3
        assert row["silent_failure_rate"] + row["flagged_rate"] <= 1.0
        assert row["silent_failure_rate"] <= row["silent_so_far_rate"]
        assert row["success_ci"][0] <= row["success_rate"] <= row["success_ci"][1]
        assert row["map_mm_ci"][0] <= row["map_mm"]["median"] <= row["map_mm_ci"][1]
        assert row["success_meant_rate"] == row["success_rate"]  # there is one object
        assert row["p_shipped"] is None  # which was not run
    best = [row for row in rows if (row["proposal"], row["injection"]) == ("table", "mixture")]
    assert [row["contact"] for row in best] == list(range(1, 9))
    assert best[-1]["map_mm"]["median"] < best[0]["map_mm"]["median"]
    assert (file.with_suffix(".png")).stat().st_size > 10_000
    assert "block.stl |" in file.with_suffix(".md").read_text(encoding="utf-8")

    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}
    more = ("--groups", "table,projection,manifold", "--minutes", "0")
    assert main(command(block, tmp_path, *more)) == 0  # nothing is begun
    assert json.loads(file.read_text(encoding="utf-8")) == rows
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}


def test_an_unknown_proposal_is_refused_in_one_line(
    block: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command(block, tmp_path, "--groups", "magic")) == 2
    assert "--groups: no 'magic'" in capsys.readouterr().err


def test_a_shipped_density_is_not_trained() -> None:
    shipped = Setting("003_cracker_box", ring(16), 16)
    assert not trained.is_learned("density", shipped)
    assert trained.is_learned("density", replace(shipped, skin=ring(8), columns=8))
    assert trained.is_learned("paper", shipped)  # no bundle has the paper's
    assert not trained.is_learned("table", shipped)
    assert trained.proposal_of("density", shipped, "").name == "density"


def test_a_density_is_trained_once_and_read_from_its_file(block: Path, tmp_path: Path) -> None:
    setting = Setting(str(block), ring(8), 8, updates=0.001)
    job = trainings.trainings([(setting, "density")], tmp_path)[setting, "density"]
    job.work(*job.arguments, *job.beside)
    (file,) = job.beside
    assert Path(file).parent == tmp_path
    sampler = trained.proposal_of("density", setting, file)
    z, live = np.eye(1, 40)[0], np.ones(40, dtype=bool)
    assert sampler.propose(z, live, 5, np.random.default_rng(0)).shape == (5, 3)


def test_the_papers_own_diffusion_is_run_by_the_papers_own_rule(
    block: Path, tmp_path: Path
) -> None:
    assert Method("paper", "paper", 100) in filter_experiment.METHODS
    variant = trained.LEARNED["paper"]
    assert (variant.training.contacts, variant.frame, variant.view) == (10_000, "pose", "plain")
    few = replace(variant, samplers=((Solver.DDIM, 2),))  # a hundred steps are slow to export
    setting = Setting(str(block), ring(8), 8, updates=0.001)
    file = tmp_path / "paper.onnx"
    trainings.train(setting, few, str(file))
    cell = Cell(setting, Method("paper", "paper", 20))
    ((first, *_),) = cells.play(cell, 0, 1, "", str(file))
    assert first[0] is not None


def test_more_trials_add_to_those_that_are_remembered(
    block: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cells, "BLOCK", 2)
    setting = Setting(str(block), ring(8), 8)
    cell = Cell(setting, Method("table", "mixture", 10))
    options = Options(tmp_path, tmp_path / "memory", workers=1)
    few = cells.run([(cell, 2)], options)[cell]
    begun = {path: path.stat().st_mtime_ns for path in (tmp_path / "memory").iterdir()}
    more = cells.run([(cell, 4)], options)[cell]
    assert len(few) == 2
    assert {seed: more[seed] for seed in few} == few
    assert len(more) == 4
    assert all(path.stat().st_mtime_ns == at for path, at in begun.items())
    assert more[2] != few[0]
    late = cells.run([(cell, 6)], replace(options, until=time.monotonic() - 1.0))[cell]
    assert late == more  # the seeds that are there


def test_cells_that_differ_are_named_differently() -> None:
    setting, method = Setting("025_mug", ring(8), 8), Method("table", "mixture", 10)
    plain = Cell(setting, method)
    assert plain.name == "trials-025_mug-8-table-mixture-10"
    names = {
        plain.name,
        Cell(setting, method, Conditions(sigma=0.1)).name,
        Cell(setting, method, Conditions(stuck=1, stuck_at=0.0)).name,
        Cell(setting, method, Conditions(stuck=1)).name,
        Cell(setting, method, touched="061_foam_brick").name,
        Cell(setting, Method("table", "mixture", 10, 20)).name,
    }
    assert len(names) == 6


def test_other_code_makes_another_job_and_other_comments_do_not() -> None:
    assert methods.code("table") == methods.code("density") != methods.code(GRID)
    source = "class A:\n    def f(self):\n        return 1\n"
    documented = (
        '"""Doc."""\nclass A:\n    """Doc."""\n\n    def f(self):  # why\n        return 1\n'
    )
    assert fingerprint._bare(source) == fingerprint._bare(documented)
    assert fingerprint._bare(source) != fingerprint._bare(source.replace("1", "2"))


def test_each_room_that_decides_results_is_in_the_key_of_a_job(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = {methods.code("table")}
    for rooms in (methods.ROOMS[:1], methods.ROOMS[1:]):
        monkeypatch.setattr(methods, "ROOMS", rooms)
        names.add(methods.code("table"))
    assert len(names) == 3


def test_other_bundles_make_another_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What an older bundle came to is not taken for what today's does."""
    before = methods.code("density")
    for name in ("box", "mug"):
        (tmp_path / "bundles" / name).mkdir(parents=True)
        (tmp_path / "bundles" / name / "bundle.json").write_bytes(b"{}")
    monkeypatch.setattr(fingerprint, "BUNDLES", tmp_path / "bundles")
    fingerprint.of_bundles.cache_clear()
    try:
        assert methods.code("density") != before
    finally:
        fingerprint.of_bundles.cache_clear()


def test_the_filter_that_experiments_call_shipped_is_the_daemons_own() -> None:
    """Nothing of the configuration is an experiment's copy."""
    assert SHIPPED.config(FilterConfig().seed) == FilterConfig()
    ours = Method("table", "paper", 20).config(FilterConfig().seed)
    changed = {"particles", "particles_max", "injected", "injection"}
    assert all(
        getattr(ours, f.name) == getattr(FilterConfig(), f.name)
        for f in fields(ours)
        if f.name not in changed
    )
    assert noise_of(FilterConfig()) == methods.NOISE


def test_a_methods_filter_has_its_sizes_and_the_given_seed() -> None:
    assert Method("table", "mixture", 20).config(follow.OWN_SEEDS).seed == follow.OWN_SEEDS
    small = Method("table", "paper", 20).config(0)
    assert (small.particles, small.particles_max, small.injected) == (20, 20, 10)
    wide = Method("table", "mixture", 100, 1000).config(0)
    assert (wide.particles, wide.particles_max) == (100, 1000)


@pytest.mark.parametrize(
    ("error_mm", "status", "succeeded", "silent"),
    [
        (9.9, Status.CONVERGED, True, False),
        (9.9, Status.AMBIGUOUS, True, False),
        (10.0, Status.CONVERGED, False, False),
        (20.1, Status.CONVERGED, False, True),
        (20.1, Status.INCONSISTENT, False, False),
        (math.nan, Status.CONVERGED, False, True),
        (math.nan, Status.SEARCHING, False, False),
    ],
)
def test_a_touch_succeeds_or_fails_by_its_error_and_status(
    error_mm: float, status: Status, succeeded: bool, silent: bool
) -> None:
    result = TouchResult(error_mm, error_mm, status, 100, error_mm)
    assert (result.succeeded, result.failed_silently) == (succeeded, silent)


def test_the_grid_learns_from_the_estimators_scans(
    ring_model: ObservationModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    contacts = []

    class Grid:
        def __init__(self, model: ObservationModel, noise: Noise, slack: Slack) -> None:
            assert (model, noise) == (ring_model, noise_of(FilterConfig()))
            assert slack == Slack(SensorPoseConfig().sigma_m, FilterConfig().nudge_m)

        def __len__(self) -> int:
            return sum(contacts)

        def update(self, scan: Observation, *, touched: bool, contact: int) -> None:
            assert np.min(scan.floor) == SILENT * Conditions().sigma
            assert contact >= contacts.count(True)
            contacts.append(touched)

        def estimate(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            return np.zeros(3), np.zeros(3)

    monkeypatch.setattr(gridded, "GridFilter", Grid)
    results = follow.follow(Trial(ring_model, 0, 3), Method(GRID), ring_model, None)
    assert [result.status for result in results] == [None] * 3
    assert contacts.count(True) >= 3
    estimator = follow.follow(
        Trial(ring_model, 0, 3), Method("table", "mixture", 20), ring_model, Table(ring_model)
    )
    assert [result.particles for result in estimator] == [20] * 3
