"""Programs that do a door harm, or are careless: the door stays, and honest peers are served."""

from pathlib import Path

import pytest

from ..rig.processes import program, resident_bytes
from . import attacks
from .stand import Stand

MOST_BYTES = 160 << 20
ESTIMATES = 20  # that an honest subscriber hears meanwhile


ATTACKS = {  # program, its argument, and how often it runs
    "subscribers shut their reading side": (attacks.SHUT, "{path}/stream", 1),
    "requests without end": (attacks.REQUESTS, "ipc://{path}/control", 2),
}


@pytest.mark.parametrize("name", ATTACKS)
def test_an_attack_costs_neither_the_door_nor_honest_peers_anything(
    tmp_path: Path, name: str
) -> None:
    code, argument, copies = ATTACKS[name]
    with Stand(tmp_path) as stand:
        door, honest = stand.pid, stand.subscriber(b"/taxeld/e")
        stand.received(honest)
        lost = stand.losses(honest)
        for _ in range(copies):
            stand.enter_context(program(code, argument.format(path=tmp_path)))
        for _ in range(ESTIMATES):
            stand.received(honest)
        assert stand.answer({"cmd": "info"})["ok"]
        stand.received(stand.subscriber(b"/taxeld/e"))
        assert resident_bytes(door) < MOST_BYTES
        assert stand.pid == door
        assert not lost.poll(0)
