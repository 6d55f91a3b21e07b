"""The checks of the package, which end with its removal; they come after those of the service."""

import os
from pathlib import Path

from checks import check
from touch import COMMAND, ON_VCAN0, VCAN0, Touch, sh, until

LIB = Path("/usr/lib/taxeld")
PACKAGE = "/vm/taxeld_*.deb"


@check
def an_installation_under_umask_077_can_be_read_by_the_daemon() -> str:
    version = sh(f"runuser -u taxeld -- {COMMAND} --version")
    assert sh(f"find {LIB} /etc/taxeld ! -type l ! -perm -a+r") == ""
    return version


@check
def an_upgrade_restarts_what_runs() -> None:
    """With the same package, which dpkg installs as it would a newer one."""
    sh("dpkg --verify taxeld")
    VCAN0.start()
    pid = VCAN0.pid
    sh(f"dpkg -i {PACKAGE}")
    until("it runs again", lambda: VCAN0.show("ActiveState") == "active" and VCAN0.pid != pid)
    with Touch(20, *ON_VCAN0) as skin:
        skin.wait_felt()


@check
def a_purge_takes_what_was_installed_and_nothing_else() -> str:
    before, after = (
        set(Path("/vm", name).read_text(encoding="utf-8").splitlines())
        for name in ("before", "after")
    )
    sh("dpkg --purge taxeld")
    until("it is stopped", lambda: VCAN0.show("ActiveState") == "inactive")
    installed = after - before
    assert len(installed) > 1000
    assert [path for path in installed if os.path.lexists(path)] == []
    assert [path for path in before if not os.path.lexists(path)] == []
    assert not LIB.exists()
    assert VCAN0.show("LoadState") == "not-found"
    assert VCAN0.config.exists()  # the administrator's
    return f"{len(installed)} files"
