"""Asking a running daemon from the command line."""

import json
import re
from collections.abc import Iterator
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
            until(lambda: _status(place)["estimate"]["contacts"])
            until(lambda: _status(place)["health"].get("dead_taxels"))
            yield place
        finally:
            daemon.terminate()
    assert daemon.returncode == 0


def _status(place: Path) -> dict[str, Any]:
    answer = client.ask(f"ipc://{place}/control", "status", timeout_s=20.0)
    assert answer is not None
    return answer


def test_status_is_aligned_names_and_values_with_units(running: Path) -> None:
    said = printed("status", running / "config.toml").splitlines()
    rows = dict(line.split(": ", maxsplit=1) for line in said)
    assert {len(name) for name in rows} == {14}
    values = {name.strip(): value for name, value in rows.items()}
    assert (values["Dead taxels"], "Bus" in values) == ("1 (4)", False)
    assert re.match(r"\d+,", values["Contacts"])
    assert re.match("median .* max", values["Total time"])
    answer = json.loads(printed("status", f"ipc://{running}/control", "--json"))
    assert set(answer) == {"ok", "estimate", "health", "waits_for", "why", "sensor_pose"}


def test_reset_tare_and_prior_wait_for_the_answer_and_say_what_happened(running: Path) -> None:
    config = running / "config.toml"
    assert _status(running)["estimate"]["contacts"] > 0
    assert printed("reset", config) == "all touches are forgotten\n"
    assert "leave the skin untouched" in printed("tare", config)
    assert "is taken" in printed("prior", config, "--at", "-0.1", "0", "nan")
    told = refused("prior", config, "--at", "99", "0", "0", status=1)
    assert told.startswith(f"ipc://{running}/control: prior: x: must be -10..10 m")


@pytest.mark.parametrize(
    ("keys", "endpoint", "status", "line"),
    [
        ("", "ipc://{place}/control", 1, "no daemon answers at {at}; is 'taxeld run' there?\n"),
        ("", "tcp://robot:1", 2, "endpoint: '{at}' is not local; use ipc:///path or tcp://127"),
        ("", "robot", 2, "robot: unreadable configuration"),
        ("/nowhere", "tcp://robot:1", 2, "TAXELD_KEYS: /nowhere/client.key_secret cannot be read"),
    ],
)
def test_a_daemon_that_cannot_be_asked_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: str,
    endpoint: str,
    status: int,
    line: str,
) -> None:
    monkeypatch.setattr(client, "TIMEOUT_S", 0.1)
    monkeypatch.setenv("TAXELD_KEYS", keys)
    at = endpoint.format(place=tmp_path)
    assert refused("tare", at, status=status).startswith(line.format(at=at))


def test_status_begins_as_the_page_of_a_first_robot_shows() -> None:
    page = (ROOT / "docs" / "first-robot.md").read_text(encoding="utf-8")
    [shown] = [text for language, text in pages.FENCED.findall(page) if language == "text"]
    of_one = {"status": Status.CONVERGED, "objects": {"bracket": 1.0, "other": 0.0}}
    said = "\n".join(lines({"estimate": ESTIMATE | of_one}))
    assert pages.NUMBER.sub("N", said).startswith(pages.NUMBER.sub("N", shown))


ESTIMATE, HEALTH = (documented(f"/taxeld/{name}")[1] for name in ("estimate", "health"))
ABSENT = "source.channel: cannot open /dev/skin (it is not there; is it plugged in?)"
POSES = "the sensor's pose: docs/troubleshooting.md#the-sensors-pose-is-missing"
OTHER_TOO = {"stands": 0.7, "moved": 0.1, "other": 0.2}
NOT_VALID = "Not valid     : "


def with_health(**keys: Any) -> dict[str, Any]:
    return {"estimate": ESTIMATE, "health": HEALTH | keys}


def with_estimate(**keys: Any) -> dict[str, Any]:
    return {"estimate": ESTIMATE | keys}


SAID: list[tuple[dict[str, Any], str]] = [  # an answer, and a line of its text, or a part of it
    (with_health() | {"waits_for": ABSENT}, f"Device        : waiting, {ABSENT}\n"),
    (with_health(calibration={"age_s": 2.5 * 86_400.0}), "Calibration   : 2.5 days old\n"),
    (with_health(), "Calibration   : none; full scale and mount are"),
    *(
        (with_health(source=HEALTH["source"] | {"bus": {"no_ack": 12, "unread": 3}}), told)
        for told in ("Bus           : no_ack 12 (nothing ackn", "; unread 3 (the kernel dropped")
    ),
    (with_health(estimator={"jumps": 3}), f"Not 0         : estimator.jumps 3: {POSES}\n"),
    *(
        (with_health(), f"Not 0         : {name}_taxels {first}: mend them; taxeld tare\n")
        for name, first in (("stuck", 17), ("saturated", 30), ("untared", 4))
    ),
    (with_estimate(status=99) | {"health": {}}, "Status        : unknown (99), valid\n"),
    (
        with_estimate(p=0.6, hypotheses=OTHER_TOO),
        "p 60.0%, radius 8.8 mm; stands 70%, moved 10%, other 20%\n",
    ),
    (
        with_estimate(p=0.5, status=Status.AMBIGUOUS),
        "Certainty     : p 50.0%, radius 8.8 mm; touch another side\n",
    ),
    *(
        (with_estimate(valid=False, why=int(why)), f"{NOT_VALID}{CURES[why]}\n")
        for why in Why
        if why is not Why.VALID
    ),
    # of a newer daemon; and with a fact, by the daemon itself
    (with_estimate(valid=False, why=99), f"{NOT_VALID}unknown (99)\n"),
    (with_estimate(valid=False, why=8) | {"why": "it seems to be at"}, f"{NOT_VALID}it seems to"),
]


@pytest.mark.parametrize(("answer", "told"), SAID, ids=[told[:40] for _, told in SAID])
def test_an_answer_becomes_lines_that_name_what_is_to_be_done(
    answer: dict[str, Any], told: str
) -> None:
    said = "".join(f"{line}\n" for line in lines(answer))
    assert told in said
    assert (NOT_VALID in said) != answer["estimate"]["valid"]
