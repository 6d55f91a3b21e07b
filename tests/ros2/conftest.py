"""Both ends of the bridge."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from .loopback import Daemon, Robot


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    with contextlib.closing(Daemon(tmp_path)) as opened:
        yield opened


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with contextlib.closing(Robot(tmp_path)) as opened:
        yield opened
