"""The name of an emulated adapter, at the harness's end of a daemon's link."""

from pathlib import Path

import pytest

from taxeld.errors import SetupError
from taxeld_hil.rig.ports import NativePort


def test_a_link_that_a_killed_emulator_left_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    link.symlink_to("/dev/pts/999999")
    port = NativePort(link)
    assert link.is_char_device()
    port.close()
    assert not link.is_symlink()


def test_the_link_of_a_living_emulator_is_left_alone(tmp_path: Path) -> None:
    link = tmp_path / "skin"
    port = NativePort(link)
    before, opened = link.readlink(), _open_files()
    with pytest.raises(SetupError, match=r"skin: cannot be made \(another skin is there; stop it"):
        NativePort(link)
    assert link.readlink() == before
    assert _open_files() == opened, "no pseudo-terminal is left open"
    port.close()


def _open_files() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize(("name", "why"), [("no/skin", "No such file"), ("file", "File exists")])
def test_a_link_that_cannot_be_made_is_one_line(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(SetupError, match=rf"{name}: cannot be made \({why}"):
        NativePort(tmp_path / name)
