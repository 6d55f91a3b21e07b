"""Both ends of the bridge."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from .loopback import Daemon, Robot


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    opened = Daemon(tmp_path)
    yield opened
    opened.close()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    opened = Robot(tmp_path)
    yield opened
    opened.close()
