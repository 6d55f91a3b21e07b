"""A skin of as many taxels as a layout may have starts and runs in little memory: nothing is of the
size of all pairs of taxels."""

import json
import re
import time
import tracemalloc
from itertools import count
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from taxeld.config.file import load
from taxeld.layout import read as layouts
from taxeld.layout.generated import Cylinder
from taxeld.layout.read import MAX_TAXELS
from taxeld.proposals import manifest
from taxeld.service.prepare import prepared
from taxeld.skin.patches import Patches
from tests.rig.array_skin import bound
from tests.rig.clocks import until
from tests.rig.configurations import configuration
from tests.rig.processes import taxeld
from tests.rig.scenes import disc, scene_of
from tests.rig.skins import table_of
from tests.rig.sockets import Sockets

COLUMNS = 200
PAIRS_BYTES = 8 * MAX_TAXELS**2  # 200 MB
MOST_BYTES = 300e6  # of a daemon, with Python and all libraries


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Of a daemon on an array of as many taxels, and a disc."""
    made = Cylinder(MAX_TAXELS // COLUMNS, COLUMNS, 0.2, 0.006).layout("many")
    (tmp_path / "many.csv").write_text(table_of(made, uid=True), encoding="ascii")
    skin = layouts.load(str(tmp_path / "many.csv"))
    manifest.save_scene(scene_of(disc(0.05), skin, symmetry=0), tmp_path / manifest.SCENE)
    about = {
        "format": manifest.FORMAT,
        "object": "disc",
        "layout": {"name": "many", "digest": skin.digest},
        "files": {manifest.SCENE: manifest.digest((tmp_path / manifest.SCENE).read_bytes())},
        "samplers": [],
        "auto": [],
        "height_m": 0.0,
        "depth_max_m": 0.005,
    }
    (tmp_path / manifest.NAME).write_text(json.dumps(about), encoding="utf-8")
    return configuration(
        tmp_path,
        skin={"layout": tmp_path / "many.csv"},
        scene={"bundle": tmp_path},
        source={"kind": "array", "endpoint": f"ipc://{tmp_path}/skin"},
    )


def test_a_start_allocates_nothing_of_the_size_of_all_pairs(config: Path) -> None:
    tracemalloc.start()
    (skin,) = prepared(load(config), 0.0).layouts
    assert len(Patches(skin, 0.005).layout) == MAX_TAXELS
    assert tracemalloc.get_traced_memory()[1] < 0.75 * PAIRS_BYTES
    tracemalloc.stop()


def test_a_daemon_starts_and_feels_contacts_in_300_mb(config: Path, sockets: Sockets) -> None:
    place, sent = config.parent, count()
    sender = sockets.keep(bound(sockets.context, f"ipc://{place}/skin"))
    heard = sockets.subscriber(f"ipc://{place}/stream", b"/taxeld/estimate")

    def has_felt() -> Any:
        """A column of taxels is pressed, then none, then the next one."""
        part, z = next(sent) // 10, np.zeros(MAX_TAXELS)
        z[part % COLUMNS :: COLUMNS] = 0.6 * (part % 2)
        scan = {"id": 0, "t": time.time(), "z": z.tolist()}
        sender.send_multipart([b"/skin", msgpack.packb(scan)])
        return heard.poll(50) and msgpack.unpackb(heard.recv_multipart()[1])["contacts"] > 2

    with taxeld("run", config) as daemon:
        try:
            until(has_felt)
            told = Path(f"/proc/{daemon.pid}/status").read_text(encoding="ascii")
            assert 1024 * int(re.findall(r"VmHWM:\s+(\d+) kB", told)[0]) < MOST_BYTES
        finally:
            daemon.terminate()
