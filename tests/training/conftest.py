"""The small box as a mesh file."""

from pathlib import Path

import pytest

from . import rig


@pytest.fixture(scope="session")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "block.stl"
    rig.box().export(path)
    return path
