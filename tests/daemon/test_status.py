"""Asking a running daemon from the command line."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from taxeld.commands.status import lines
from taxeld.estimator.estimate import Status
from taxeld.pipeline.freshness import CURES, Why
from taxeld.stream import client
from tests import pages
from tests.rig.clocks import until
from tests.rig.commands import printed, refused
from tests.rig.configurations import configuration
from tests.rig.processes import taxeld
from tests.rig.recorded import LiveSkin
from tests.rig.stream_page import ROOT, documented


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The place of a daemon whose skin is touched again and again."""
    place = tmp_path_factory.mktemp("daemon")
    with (
        LiveSkin(place, touches=40) as skin,
        taxeld("run", configuration(place, source=skin.source)) as daemon,
    ):
        try:
            until(lambda: client.ask(f"ipc://{place}/control", "info", timeout_s=0.5))
            until(lambda: _contacts(place) and _status(place)["health"].get("dead_taxels"))
            yield place
        finally:
            daemon.terminate()
    assert daemon.returncode == 0


def _status(place: Path) -> dict[str, Any]:
    answer = client.ask(f"ipc://{place}/control", "status", timeout_s=20.0)
    assert answer is not None
    return answer


def _contacts(place: Path) -> int:
    return int(_status(place)["estimate"]["contacts"])


def test_status_is_aligned_names_and_values_with_units(running: Path) -> None:
    rows = dict(
        line.split(": ", maxsplit=1)
        for line in printed("status", running / "config.toml").splitlines()
    )
    assert {len(name) for name in rows} == {14}
    values = {name.strip(): value for name, value in rows.items()}
    assert values["Contacts"].split(",")[0].isdigit()
    assert values["Dead taxels"] == "1 (4)"
    assert values["Total time"].startswith("median ")
    assert " mm, y " in values["Uncertainty"]
    answer = json.loads(printed("status", f"ipc://{running}/control", "--json"))
    assert set(answer) == {"ok", "estimate", "health", "waits_for", "why", "sensor_pose"}


def test_reset_tare_and_prior_wait_for_the_answer_and_say_what_happened(running: Path) -> None:
    config = running / "config.toml"
    assert _contacts(running) > 0
    assert printed("reset", config) == "all touches are forgotten\n"
    assert "leave the skin untouched" in printed("tare", config)
    assert "is taken" in printed("prior", config, "--at", "-0.1", "0", "nan")
    told = refused("prior", config, "--at", "99", "0", "0", status=1)
    assert told.startswith(f"ipc://{running}/control: prior: x: must be -10..10 m")


def test_a_daemon_that_is_not_there_is_one_line_and_status_1(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 0.1)
    said = refused("tare", f"ipc://{tmp_path}/control", status=1)
    assert said == f"no daemon answers at ipc://{tmp_path}/control; is 'taxeld run' there?\n"


@pytest.mark.parametrize(
    ("keys", "endpoint", "line"),
    [
        (
            "",
            "tcp://robot:1",
            "endpoint: 'tcp://robot:1' is not local; use ipc:///path or tcp://127",
        ),
        ("", "robot", "robot: unreadable configuration"),
        ("/nowhere", "tcp://robot:1", "TAXELD_KEYS: /nowhere/client.key_secret cannot be read"),
    ],
)
def test_a_wrong_endpoint_is_one_line_and_status_2(
    monkeypatch: pytest.MonkeyPatch, keys: str, endpoint: str, line: str
) -> None:
    monkeypatch.setenv("TAXELD_KEYS", keys)
    assert refused("status", endpoint).startswith(line)


def rows_of(**answer: Any) -> dict[str, str]:
    """The rows of an answer that is as documented but for this."""
    usual = {name: documented(f"/taxeld/{name}")[1] for name in ("estimate", "health")}
    rows = (row.partition(": ") for row in lines(usual | answer))
    return {name.rstrip(): value for name, _, value in rows}


def test_status_begins_as_the_page_of_a_first_robot_shows() -> None:
    page = (ROOT / "docs" / "first-robot.md").read_text(encoding="utf-8")
    [shown] = [text for language, text in pages.FENCED.findall(page) if language == "text"]
    of_one = {"status": Status.CONVERGED, "objects": {"bracket": 1.0, "other": 0.0}}
    estimate = documented("/taxeld/estimate")[1] | of_one
    said = "\n".join(lines({"estimate": estimate}))
    number = partial(pages.NUMBER.sub, "N")
    assert number(said).startswith(number(shown))


def test_a_device_that_is_waited_for_and_the_age_of_a_calibration_have_a_row() -> None:
    cause = "source.channel: cannot open /dev/skin (it is not there; is it plugged in?)"
    assert rows_of(waits_for=cause)["Device"] == f"waiting, {cause}"
    health = documented("/taxeld/health")[1]
    for age_s, told in ((2.5 * 86_400.0, "2.5 days old"), (-1.0, "none; full scale and mount are")):
        row = rows_of(health=health | {"calibration": {"age_s": age_s}})["Calibration"]
        assert told in row


def test_a_daemon_without_health_yet_has_a_status_and_faults_of_the_bus_have_a_row(
    running: Path,
) -> None:
    answer = _status(running)
    assert not any(line.startswith("Bus") for line in lines(answer))
    answer["health"]["source"]["bus"] |= {"no_ack": 12, "unread": 3}
    (row,) = (line for line in lines(answer) if line.startswith("Bus"))
    assert "no_ack 12 (nothing acknowledges; see" in row
    assert "; unread 3 (the kernel dropped" in row
    answer["health"] = {}
    answer["estimate"]["status"] = 99
    assert "unknown (99), " in next(lines(answer))


def test_a_value_has_a_row_where_it_is_not_0_and_has_a_cure() -> None:
    answer = {
        "estimate": documented("/taxeld/estimate")[1],
        "health": documented("/taxeld/health")[1],
    }
    answer["health"]["estimator"]["jumps"] = 3
    cure = "the sensor's pose: docs/troubleshooting.md#the-sensors-pose-is-missing"
    assert [line.partition(": ")[2] for line in lines(answer) if line.startswith("Not 0")] == [
        f"estimator.jumps 3: {cure}",
        "stuck_taxels 17: mend them; taxeld tare",
        "saturated_taxels 30: mend them; taxeld tare",
        "untared_taxels 4: mend them; taxeld tare",
    ]


def test_status_says_why_an_estimate_is_not_valid() -> None:
    answer: dict[str, Any] = {"estimate": documented("/taxeld/estimate")[1]}
    assert not any(line.startswith("Not valid") for line in lines(answer))
    for why in Why:
        answer["estimate"] |= {"valid": why is Why.VALID, "why": int(why)}
        row = list(lines(answer))[1]
        assert why is Why.VALID or row == f"Not valid     : {CURES[why]}"
    answer["why"] = "it seems to be at x 0.840 m"  # with a fact, by the daemon itself
    assert list(lines(answer))[1] == f"Not valid     : {answer['why']}"
    answer["estimate"]["why"], answer["why"] = 99, ""  # of a newer daemon
    assert list(lines(answer))[1] == "Not valid     : unknown (99)"


@pytest.mark.parametrize(
    ("said", "line"),
    [
        (
            {"p": 0.6, "hypotheses": {"stands": 0.7, "moved": 0.1, "other": 0.2}},
            "p 60.0%, radius 8.8 mm; stands 70%, moved 10%, other 20%",
        ),
        ({"p": 0.5, "status": Status.AMBIGUOUS}, "p 50.0%, radius 8.8 mm; touch another side"),
    ],
)
def test_p_and_radius_are_told_and_what_else_it_may_be(said: dict[str, Any], line: str) -> None:
    estimate = documented("/taxeld/estimate")[1] | said
    assert f"Certainty     : {line}" in lines({"estimate": estimate})
