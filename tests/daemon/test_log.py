"""What the daemon logs, for whom, and how often."""

import logging
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from taxeld.config.tables import FilterConfig
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Pipeline
from taxeld.proposals import bundle, choice
from taxeld.proposals.analytic import Projection
from taxeld.service import log
from taxeld.service.notices import Notices
from taxeld.stream import client
from taxeld_protocol.decoder import Scan
from tests.rig.clocks import until
from tests.rig.configurations import config, configuration
from tests.rig.processes import PIPES, taxeld
from tests.rig.recorded import LiveSkin
from tests.rig.simulated_skin import SimulatedSkin

SPEC = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"
RECORD = logging.LogRecord("taxeld", logging.WARNING, "", 0, "a line\nand another", None, None)


def test_the_journal_is_told_the_priority_of_each_line(tmp_path: Path) -> None:
    with (tmp_path / "journal").open("w") as stream:
        found = os.fstat(stream.fileno())
        environ = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino}"}
        assert log.formatter(stream.fileno(), environ).format(RECORD) == "<4>a line\n<4>and another"
        elsewhere = {"JOURNAL_STREAM": f"{found.st_dev}:{found.st_ino + 1}"}
        assert "<4>" not in log.formatter(stream.fileno(), elsewhere).format(RECORD)


@pytest.fixture
def logged(caplog: pytest.LogCaptureFixture) -> Iterator[Callable[[], list[str]]]:
    """→ what was logged since asked last."""

    def taken() -> list[str]:
        lines = [f"{record.levelname}: {record.getMessage()}" for record in caplog.records]
        caplog.clear()
        return lines

    with caplog.at_level(logging.INFO, logger="taxeld"):
        yield taken


@pytest.fixture
def estimate(disc_model: ObservationModel) -> Estimate:
    first = Estimator(disc_model, Projection(disc_model), FilterConfig()).estimate
    return replace(first, status=Status.SEARCHING)


def notices(pipeline: Pipeline | None = None) -> Notices:
    return Notices(SimpleNamespace(pipeline=pipeline), ["box"])  # type: ignore[arg-type]


def test_a_change_of_status_is_logged_once(
    estimate: Estimate, logged: Callable[[], list[str]]
) -> None:
    told, stale = notices(), replace(estimate, status=Status.STALE)
    sure = replace(estimate, p=0.9962, radius_m=0.0088)
    valid = r"x \S+ m, y \S+ m, yaw \S+ rad, p 99.6%, radius 8.8 mm"
    for now_s, one, why, reason, line in (
        (0.0, estimate, Why.UNTOUCHED, "touch it", "INFO: searching, not valid, .*: touch it"),
        (1.0, estimate, Why.UNTOUCHED, "touch it", ""),
        (10.0, estimate, Why.VAGUE, "again", "INFO: searching, not valid, 0 contacts: again"),
        (20.0, stale, Why.NO_SCAN, "no scan", "WARNING: stale, not valid, 0 contacts: no scan"),
        (30.0, sure, Why.VALID, "", f"INFO: searching, valid, 0 contacts, {valid}"),
    ):
        told.estimate(one, why, reason, now_s)
        assert re.fullmatch(line.replace(": ", ": status: ", 1), "".join(logged()))


def test_a_status_that_flaps_is_logged_ever_less_often_and_the_last_one_is_logged(
    estimate: Estimate, logged: Callable[[], list[str]]
) -> None:
    told, stale = notices(), replace(estimate, status=Status.STALE)
    for k in range(400):  # twenty seconds, as often as estimates are published
        one = (estimate, Why.UNTOUCHED, "") if k // 10 % 2 else (stale, Why.NO_SCAN, "")
        told.estimate(*one, 0.05 * k)
    assert 3 <= len(logged()) <= 8
    for k in range(400, 700):
        told.estimate(estimate, Why.VALID, "", 0.05 * k)
    assert logged()[-1].startswith("INFO: status: searching, valid")
    told.estimate(stale, Why.NO_SCAN, "no scan comes", 60.0)
    assert len(logged()) == 1, "at once, once it was calm"


def hub_of(modules: int) -> tuple[Pipeline, SimulatedSkin]:
    """A pipeline for the layout of eight modules, and a skin whose hub has so many of them."""
    whole = layouts.load(SPEC)
    loaded = bundle.load("box", whole, 0.005)
    skin = SimulatedSkin(whole, noise=5.0)
    pipeline = Pipeline(config(), [whole], [loaded.model], choice.samples([loaded], FilterConfig()))
    for _ in range(30):
        list(pipeline.advance([cut(skin.scan(), modules)], skin.t))
    return pipeline, skin


def cut(scan: Scan, modules: int) -> Scan:
    """The scan of a hub that has the first so many modules alone."""
    table = scan.table[:modules]
    counts = scan.counts[: sum(module.channels for module in table)]
    return replace(scan, table=table, counts=counts)


def test_what_is_wrong_with_poses_and_modules_is_logged_once_and_so_is_its_end(
    logged: Callable[[], list[str]],
) -> None:
    pipeline, skin = hub_of(5)
    told = notices(pipeline)

    def looked(fault: str) -> list[str]:
        """Eight looks, a second each."""
        logged()
        for _ in range(8):
            told.inputs(fault, 0.0)
        return logged()

    missing = "3 of its 8 modules are on no hub (SUI 6, 7, 8)"
    assert looked("no pose comes") == [
        "WARNING: sensor_pose: no pose comes",
        "INFO: hub 1 sends: 5 modules, 5 of them in the layout",
        f"WARNING: skin.layout: {missing}; estimates are not valid: give the layout of this skin, "
        "or see to its modules",
    ]
    assert pipeline.health()["missing_modules"] == [6, 7, 8]
    touched = replace(pipeline.estimate, contacts=1, status=Status.AMBIGUOUS, p=0.5)
    assert pipeline.freshness.why(touched) is Why.MODULES_MISSING
    for stage in pipeline.stages:
        allowed = replace(stage.config.skin, missing_modules=3)
        stage.config = replace(stage.config, skin=allowed)
    list(pipeline.advance([cut(skin.scan(), 5)], skin.t))
    assert pipeline.freshness.why(touched) is Why.VALID
    (line,) = [line for line in looked("") if "layout" in line]
    assert line == f"WARNING: skin.layout: {missing}; is it the layout of this skin?"
    list(pipeline.advance([replace(skin.scan(), table_version=99)], skin.t))
    assert looked("") == [
        "INFO: hub 1 sends: 8 modules, 8 of them in the layout",
        "INFO: skin.layout: all its modules are there",
    ]


def test_a_daemon_says_when_it_is_ready_with_what(tmp_path: Path) -> None:
    with LiveSkin(tmp_path, touches=0, period_s=0.02) as skin:
        config = configuration(tmp_path, source=skin.source)
        with taxeld("run", config, **PIPES) as daemon:
            assert daemon.stderr is not None
            lines = [daemon.stderr.readline()]
            while "in the layout" not in lines[-1]:
                lines.append(daemon.stderr.readline())
            daemon.terminate()
    assert "ready: skin cylinder:rows=5" in lines[0]
    assert "80 taxels; object 003_cracker_box; samples by " in lines[0]
    assert f"source can {tmp_path}/skin, open" in lines[0]
    assert f"streams at ipc://{tmp_path}/stream; control at ipc://{tmp_path}/control" in lines[0]
    assert lines[-1].endswith("hub 1 sends: 8 modules, 8 of them in the layout\n")


def test_a_run_with_a_log_level_logs_nothing_below_it(tmp_path: Path) -> None:
    with taxeld("run", configuration(tmp_path, log={"level": "error"}), **PIPES) as daemon:
        until(lambda: client.ask(f"ipc://{tmp_path}/control", "info", timeout_s=0.5))
        daemon.terminate()
        assert daemon.communicate() == ("", "")
