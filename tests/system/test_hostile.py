"""Attacks on a daemon and its relay as processes, in short form (benchmarks/hostile.py)."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "hostile.py"
GROWN_MAX_MB, RELAY_GROWN_MAX_MB = 20.0, 200.0  # however fast it is sent
ANSWER_ESTIMATES = 40  # of twenty a second; `taxeld status` asks again for two seconds
NEAR_M = 0.05
ATTACKS = [
    "subscribe and leave, tcp",
    "subscribe and leave, ipc",
    "ask and leave, ipc",
    "a flood that exits, ipc",
    "idle connections, tcp",
    "idle connections, ipc",
    "a crowd, tcp",
    "unique subscriptions, tcp",
    "unique subscriptions, ipc",
    "endless message, tcp",
    "endless message, ipc",
    "endless request, ipc",
    "a stranger unsubscribes, ipc",
    "a request of many frames, ipc",
    "poses of another arm",
    "poses far away, some",
    "poses far away, all",
    "poses from the future",
    "poses of 5 000 frames",
    "a reader tares in a loop",
    "socket files removed",
    "signals to the daemon",
    "signals to the relay",
]

Row = dict[str, Any]


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Row]:
    out = tmp_path_factory.mktemp("hostile") / "rows.json"
    command = [sys.executable, str(BENCHMARK), "--short", "--json", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return {row["attack"]: row for row in json.loads(out.read_text(encoding="utf-8"))}


def test_every_attack_in_short_form_is_judged(rows: dict[str, Row]) -> None:
    assert list(rows) == ATTACKS


def test_an_attacker_reaches_what_it_attacks(rows: dict[str, Row]) -> None:
    """`did`: what a process of its own has done; a robot that errs, and signals, are none."""
    did = {attack: row["did"] for attack, row in rows.items() if row["did"] is not None}
    assert len(did) > len(ATTACKS) / 2
    assert [attack for attack, counts in did.items() if not sum(counts.values())] == []


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_neighbour_does_not_stop_the_daemon(rows: dict[str, Row], attack: str) -> None:
    row = rows[attack]
    assert row["daemon"] == "alive"
    assert row["relay"] in ("alive", "-")  # "-": where the daemon serves TCP itself
    assert row["newcomer"]  # who subscribes afterwards is served
    assert row["answer_estimates"] is not None  # who asks is answered
    assert row["answer_estimates"] < ANSWER_ESTIMATES
    assert row["grown_mb"] < GROWN_MAX_MB
    assert row["relay_grown_mb"] < RELAY_GROWN_MAX_MB


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_healthy_subscriber_misses_nothing(rows: dict[str, Row], attack: str) -> None:
    row = rows[attack]
    if row["paused_s"] > 0.3:
        pytest.skip("the machine held up the subscriber itself")
    assert row["missed"] == 0
    assert row["silent_taxels"] < 20


@pytest.mark.parametrize("attack", ATTACKS)
def test_no_estimate_that_says_it_is_valid_is_far_from_the_object(
    rows: dict[str, Row], attack: str
) -> None:
    assert rows[attack]["off_m"] < NEAR_M
