"""Programs that do a door harm, or are careless: the door stays, and honest peers are served."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from taxeld.stream.link import Report

from ..rig.processes import program, resident_bytes
from . import attacks
from .stand import Stand, needs_root, open_to_all, robots_endpoint

KERNEL = tuple(map(int, os.uname().release.split(".")[:2]))
MOST_BYTES = 160 << 20
ESTIMATES = 20  # that an honest subscriber hears meanwhile


class Attack(NamedTuple):
    """`arguments`: with names of the stand; `works`: whether a report tells of the attack."""

    program: str
    arguments: str
    works: Callable[[Report], Any] = lambda _: True
    copies: int = 1


ATTACKS = {
    "subscribers shut their reading side": Attack(attacks.SHUT, "{path}/stream"),
    "a message without end": Attack(attacks.HOARD, "{path}/stream", lambda r: r.hoarders >= 3),
    "asking for the description again": Attack(attacks.ASK_AGAIN, "{path}/stream"),
    "requests without end": Attack(attacks.REQUESTS, "ipc://{path}/control", copies=2),
    "a false robot": Attack(attacks.ENDLESS_POSE, "{port}", lambda r: r.hoarders >= 3),
    "descriptors that linger": Attack(attacks.LINGER, "{path}/stream", copies=3),
    "every place of control": Attack(
        attacks.PLACES, "{path}/control", lambda r: r.crowded_out > 100
    ),
    "every place of the stream": Attack(
        attacks.PLACES, "{path}/stream", lambda r: r.crowded_out > 100
    ),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_costs_neither_the_door_nor_honest_peers_anything(
    tmp_path: Path, name: str
) -> None:
    if name.startswith("every place") and needs_root[0]:
        pytest.skip(needs_root[1])
    if name == "descriptors that linger" and KERNEL < (6, 16):
        pytest.skip("before Linux 6.16 the door cannot refuse them; the loop is not concerned")
    attack, endpoint = ATTACKS[name], robots_endpoint()
    names = {"path": tmp_path, "robot": endpoint, "port": endpoint.rpartition(":")[2]}
    with Stand(tmp_path, robot=endpoint) as stand:
        open_to_all(tmp_path)
        door, honest = stand.pid, stand.subscriber(b"/taxeld/e")
        stand.received(honest)
        lost = stand.losses(honest)
        for _ in range(attack.copies):
            stand.enter_context(program(attack.program, attack.arguments.format(**names)))
        stand.until(lambda: attack.works(stand.link.report))
        for _ in range(ESTIMATES):
            stand.received(honest)
        assert stand.answer({"cmd": "info"})["ok"]
        stand.received(stand.subscriber(b"/taxeld/e"))
        assert resident_bytes(door) < MOST_BYTES
        assert stand.pid == door
        assert not lost.poll(0)
