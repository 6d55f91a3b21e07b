"""The checks of installing, upgrading and removing; they come after those of the service."""

import os
from pathlib import Path

from checks import check
from touch import ON_VCAN0, VCAN0, Touch, Unit, sh, until

LIB = Path("/usr/local/lib/taxeld")
PACKAGED = Path("/usr/lib/taxeld")


def used() -> Path:
    return (LIB / "current").resolve()


def previous() -> Path:
    return (LIB / "previous").resolve()


def running() -> Path:
    """The version whose interpreter the instance runs."""
    command = Path(f"/proc/{VCAN0.pid}/cmdline").read_bytes().split(b"\0")[0]
    return Path(command.decode()).parents[1]


@check
def an_installation_under_umask_077_can_be_read_by_the_daemon() -> str:
    version = sh("runuser -u taxeld -- /usr/local/bin/taxeld --version")
    assert sh(f"find {LIB} /etc/taxeld ! -type l ! -perm -a+r") == ""
    return version


@check
def an_upgrade_that_fails_leaves_the_old_version_running() -> str:
    """Half a wheel; and a version that refuses the configuration in use."""
    Unit("slcan0").config.unlink(missing_ok=True)
    VCAN0.start()
    before, pid = used(), VCAN0.pid
    assert running() == before
    for wheel, complaint in (
        ("taxeld-100.0", "the new version cannot be built; nothing was changed"),
        ("taxeld-99.0", "vcan0.toml: works with the version in use, and not with 99.0"),
    ):
        (path,) = Path("/vm/upgrades").glob(f"{wheel}-*.whl")
        install = f"make -s -C /src install PYTHON=/vm/clone WHEEL={path}"
        said = sh(f"{install} 2>&1 && echo installed || true")
        assert complaint in said, said
        assert not said.endswith("installed"), said
        assert used() == before
        assert set((LIB / "versions").iterdir()) == {before, previous()}
    assert VCAN0.pid == pid
    with Touch(20, *ON_VCAN0) as skin:
        skin.wait_felt()
    return before.name


@check
def a_rollback_is_taken_up_by_a_restart() -> str:
    now, before, pid = used(), previous(), VCAN0.pid
    said = sh("make -s -C /src rollback")
    assert f"{before.name} is used again" in said, said
    assert (used(), previous()) == (before, now)
    assert (VCAN0.pid, running()) == (pid, now)
    sh("systemctl try-restart 'taxeld*@*'")
    assert running() == before
    with Touch(21, *ON_VCAN0) as skin:
        skin.wait_felt()
    return before.name


@check
def uninstall_takes_what_install_put_and_nothing_else() -> str:
    before, after = (
        set(Path("/vm", name).read_text(encoding="utf-8").splitlines())
        for name in ("before", "after")
    )
    sh(f"systemctl disable --now {VCAN0.name}")
    sh("make -C /src uninstall")
    installed = after - before
    assert len(installed) > 1000
    assert [path for path in installed if os.path.lexists(path)] == []
    assert [path for path in before if not os.path.lexists(path)] == []
    return f"{len(installed)} files"


@check
def the_debian_package_is_installed_runs_and_is_removed() -> None:
    sh("dpkg -i /vm/taxeld_*.deb")
    sh("dpkg --verify taxeld")
    sh(f"systemctl enable {VCAN0.name}")
    VCAN0.start()
    assert running() == (PACKAGED / "current").resolve()
    with Touch(22, *ON_VCAN0) as skin:
        skin.wait_felt()
    sh("dpkg --purge taxeld")
    until("it is stopped", lambda: VCAN0.show("ActiveState") == "inactive")
    assert not PACKAGED.exists()
    assert VCAN0.show("LoadState") == "not-found"
    assert VCAN0.config.exists()  # the administrator's
