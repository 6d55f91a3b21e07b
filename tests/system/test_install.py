"""`make install`, `make rollback` and `make uninstall`, with a Python that only plays building."""

import fcntl
import os
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ..rig.clocks import until

pytestmark = pytest.mark.check

ROOT = Path(__file__).parents[2]

# Makes an environment of version $BUILDS, whose `taxeld check` refuses a line $REFUSES
PYTHON = r"""#!/bin/sh
here=$(dirname "$(dirname "$0")")
case "$*" in
"-m venv "*)
    mkdir -p "$3/bin"
    cp "$0" "$3/bin/python"
    echo "command = python -m venv $3" >"$3/pyvenv.cfg" ;;
*"pip "*" --require-hashes "*)
    [ "$FAILS_AT" != dependencies ] || { echo "pip: no space left on device" >&2; exit 1; }
    [ "$FAILS_AT" != a-signal ] || { echo here >"$here/../../hangs"; sleep 60; } ;;
*"pip "*" --no-deps "*)
    [ "$FAILS_AT" != wheel ] || exit 1
    echo "$BUILDS" >"$here/version"
    echo "$REFUSES" >"$here/refuses"
    for name in taxeld taxeld-hil taxeld-ros2 taxeld-train; do
        printf '#!%s/bin/python\n' "$here" >"$here/bin/$name"
    done
    for file in include/taxeld_protocol.h share/man/man1/taxeld.1 \
        share/bash-completion/completions/taxeld share/zsh/site-functions/_taxeld; do
        mkdir -p "$here/${file%/*}"
        echo file >"$here/$file"
    done ;;
*" --version") [ "$FAILS_AT" != version ] && cat "$here/version" ;;
*" check "*)
    for config; do :; done
    ! grep -qxFf "$here/refuses" "$config" || { echo "loop.$(cat "$here/refuses")" >&2; exit 2; } ;;
esac
"""


class Machine:
    """A place to install to, with commands that only note that they were called."""

    def __init__(self, at: Path) -> None:
        self.at, self.prefix, self.configs = at, at / "opt", at / "etc"
        self.lib = self.prefix / "lib" / "taxeld"
        self.command = self.prefix / "bin" / "taxeld"
        self.unit = self.prefix / "lib" / "systemd" / "system" / "taxeld@.service"
        self.configs.mkdir()
        bin_ = at / "bin"
        bin_.mkdir()
        for name, text in {
            "python": PYTHON,
            "systemd-sysusers": '#!/bin/sh\n[ "$FAILS_AT" != sysusers ] && test -f "$1"\n',
        }.items():
            (bin_ / name).write_text(text, encoding="utf-8")
            (bin_ / name).chmod(0o755)
        for name in ("systemctl", "sync"):
            (bin_ / name).symlink_to("/bin/true")
        self.installed = 0

    def start(
        self,
        target: str,
        fails_at: str = "",
        refuses: str = "-",
        builds: str = "1.0",
        **variables: str,
    ) -> "subprocess.Popen[str]":
        self.installed += 1
        alone = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}  # of `make test`
        path = f"{self.at / 'bin'}:{alone['PATH']}"
        variables = {
            "PREFIX": str(self.prefix),
            "CONFIGS": str(self.configs),
            "DESTDIR": "",
            "PYTHON": str(self.at / "bin" / "python"),
            "STAMP": str(self.installed),
            **variables,
        }
        # a shell's background job ignores SIGINT, and all that it starts does
        plain = ["env", "--default-signal=INT"]
        return subprocess.Popen(
            [*plain, "make", "--silent", target, *(f"{k}={v}" for k, v in variables.items())],
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**alone, "PATH": path, "BUILDS": builds, "REFUSES": refuses, "FAILS_AT": fails_at},
        )

    def make(self, target: str, works: bool = True, **how: str) -> str:
        with self.start(target, **how) as running:
            said, _ = running.communicate(timeout=60.0)
        assert (running.returncode == 0) == works, said
        return said

    def is_idle(self) -> bool:
        """Whether no installation is at work."""
        directory = os.open(self.lib, os.O_RDONLY)
        try:
            fcntl.flock(directory, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        finally:
            os.close(directory)
        return True

    def used(self) -> str:
        """The version that the command would start, as its own interpreter is named."""
        first = self.command.read_text(encoding="utf-8").splitlines()[0]
        python = Path(first.removeprefix("#!"))
        assert python == (self.lib / "current").resolve() / "bin" / "python"
        return (python.parents[1] / "version").read_text(encoding="utf-8").strip()

    def tree(self) -> dict[str, str]:
        """Every file and link, with what it holds."""
        return {
            str(path.relative_to(self.at)): str(path.readlink())
            if path.is_symlink()
            else path.read_text(encoding="utf-8")
            for path in self.prefix.rglob("*")
            if path.is_symlink() or path.is_file()
        }


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


def test_an_upgrade_is_used_and_a_rollback_uses_the_version_before_it(machine: Machine) -> None:
    machine.make("install", builds="1.0")
    assert machine.used() == "1.0"
    said = machine.make("install", builds="2.0")
    assert machine.used() == "2.0"
    assert "1.0-1 is kept" in said
    assert "systemctl try-restart" in said
    said = machine.make("rollback")
    assert machine.used() == "1.0"
    assert said.startswith("taxeld 1.0-1 is used again, 2.0-2 is kept")
    machine.make("rollback")
    assert machine.used() == "2.0"


def test_a_version_that_a_process_still_runs_is_kept(machine: Machine) -> None:
    machine.make("install", builds="1.0")
    sleep = machine.lib / "current" / "bin" / "sleep"
    sleep.write_bytes(Path("/bin/sleep").read_bytes())
    sleep.chmod(0o755)
    with subprocess.Popen([sleep, "60"]) as running:
        machine.make("install", builds="2.0")
        machine.make("install", builds="3.0")
        assert (machine.lib / "versions" / "1.0-1").exists()
        running.kill()
    machine.make("install", builds="4.0")
    assert not (machine.lib / "versions" / "1.0-1").exists()


@pytest.mark.parametrize("step", ["dependencies", "wheel", "version", "sysusers", "full disk"])
def test_an_upgrade_that_fails_changes_nothing(machine: Machine, step: str) -> None:
    machine.make("install", builds="1.0")
    before, sync = machine.tree(), machine.at / "bin" / "sync"
    sync.unlink()
    sync.symlink_to("/bin/false" if step == "full disk" else "/bin/true")
    machine.make("install", works=False, builds="2.0", fails_at=step)
    assert machine.tree() == before
    sync.unlink()
    sync.symlink_to("/bin/true")
    machine.make("install", builds="2.0")
    assert machine.used() == "2.0"


def test_a_version_is_never_written_over(machine: Machine) -> None:
    machine.make("install", builds="1.0", STAMP="today")
    machine.make("install", builds="2.0", STAMP="today")
    before = machine.tree()
    machine.make("install", works=False, builds="1.0", STAMP="today")
    machine.make("install", works=False, builds="2.0", STAMP="today")
    assert machine.tree() == before


def test_a_first_installation_that_fails_leaves_nothing(machine: Machine) -> None:
    machine.make("install", works=False, fails_at="wheel")
    assert machine.tree() == {}
    assert not machine.lib.exists()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_an_upgrade_that_is_interrupted_leaves_the_old_version_in_use(
    machine: Machine, number: signal.Signals
) -> None:
    machine.make("install", builds="1.0")
    before = machine.tree()
    with machine.start("install", builds="2.0", fails_at="a-signal") as running:
        until((machine.lib / "hangs").exists)
        (machine.lib / "hangs").unlink()
        os.killpg(running.pid, number)
    assert running.returncode != 0
    until(machine.is_idle)  # make has ended, and what it called may still clear up
    kept = {k: v for k, v in machine.tree().items() if "/.new/" not in k}
    assert kept == before
    machine.make("install", builds="2.0")
    assert machine.used() == "2.0"
    assert not (machine.lib / "versions" / ".new").exists()


def test_a_configuration_that_only_the_new_version_refuses_stops_the_upgrade(
    machine: Machine,
) -> None:
    machine.make("install", builds="1.0")
    (machine.configs / "arm.toml").write_text("fine\n", encoding="utf-8")
    config = machine.configs / "can0.toml"
    config.write_text("rate\n", encoding="utf-8")
    before = machine.tree()
    said = machine.make("install", works=False, builds="2.0", refuses="rate")
    assert f"{config}: works with the version in use, and not with 2.0: loop.rate" in said
    assert "arm.toml" not in said
    assert machine.tree() == before


def test_a_configuration_that_neither_version_accepts_is_named_and_stops_nothing(
    machine: Machine,
) -> None:
    """Its device may be unplugged, or the service may never have run here."""
    (machine.configs / "can0.toml").write_text("rate\n", encoding="utf-8")
    for builds in ("1.0", "2.0"):
        said = machine.make("install", builds=builds, refuses="rate")
        assert "can0.toml: does not pass 'taxeld check' before or after: loop.rate" in said
        assert machine.used() == builds


def test_whatever_the_umask_every_user_can_read_what_is_installed(machine: Machine) -> None:
    before = os.umask(0o077)
    try:
        machine.make("install")
    finally:
        os.umask(before)
    for path in (machine.prefix, *machine.prefix.rglob("*")):
        mode = path.stat().st_mode
        assert mode & 0o044 == 0o044, path
        assert mode & 0o011 == 0o011 or not path.is_dir(), path


def test_a_rollback_brings_the_unit_back_too(machine: Machine) -> None:
    machine.make("install", builds="1.0")
    was = machine.unit.read_text(encoding="utf-8")
    old = machine.lib / "versions" / "1.0-1" / "prefix" / "lib" / "systemd" / "system"
    (old / machine.unit.name).write_text("[Service]\n", encoding="utf-8")
    (old / "taxeld-old@.service").write_text("[Service]\n", encoding="utf-8")
    machine.make("install", builds="2.0")
    assert machine.unit.read_text(encoding="utf-8") == was
    machine.make("rollback")
    assert machine.unit.read_text(encoding="utf-8") == "[Service]\n"
    assert machine.unit.with_name("taxeld-old@.service").exists()
    machine.make("rollback")
    assert machine.unit.read_text(encoding="utf-8") == was
    assert not machine.unit.with_name("taxeld-old@.service").exists()


def test_a_rollback_with_no_version_before_says_so(machine: Machine) -> None:
    machine.make("install")
    before = machine.tree()
    said = machine.make("rollback", works=False)
    assert said.startswith(f"make rollback: no earlier version in {machine.lib}")
    assert machine.tree() == before


@pytest.mark.parametrize("staged", [False, True])
def test_uninstall_takes_exactly_what_install_put(machine: Machine, staged: bool) -> None:
    """Also in a package's tree, which is put together beside the place where it will be."""
    (machine.configs / "can0.toml").write_text("", encoding="utf-8")
    machine.prefix.mkdir()
    (machine.prefix / "lib").mkdir()
    (machine.prefix / "lib" / "other").write_text("", encoding="utf-8")
    how = {"DESTDIR": str(machine.at), "PREFIX": "/opt", "CONFIGS": "/etc"} if staged else {}
    machine.make("install", **how)
    assert {p for p in machine.tree() if "/taxeld/versions/" not in p} == {
        "opt/bin/taxeld",
        "opt/lib/other",
        "opt/lib/taxeld/current",
        "opt/lib/sysusers.d/taxeld.conf",
        "opt/share/doc/taxeld/examples/60-can0.network",
        "opt/share/doc/taxeld/examples/60-taxeld.rules",
        "opt/share/doc/taxeld/examples/can0.toml",
        "opt/share/doc/taxeld/service.md",
        "opt/bin/taxeld-hil",
        "opt/bin/taxeld-ros2",
        "opt/bin/taxeld-train",
        "opt/include/taxeld_protocol.h",
        "opt/share/man/man1/taxeld.1",
        "opt/share/bash-completion/completions/taxeld",
        "opt/share/zsh/site-functions/_taxeld",
        *(f"opt/lib/systemd/system/{p.name}" for p in (ROOT / "systemd").glob("*.service")),
    }
    lib = "/opt/lib/taxeld" if staged else str(machine.lib)
    unit = machine.unit.read_text(encoding="utf-8")
    assert f"ExecStart={lib}/current/bin/taxeld run /etc/taxeld/%i.toml" in unit
    assert not [p for p, text in machine.tree().items() if staged and str(machine.at) in text]
    machine.make("install", **how)
    machine.make("uninstall", **how)
    assert set(machine.tree()) == {"opt/lib/other"}
    assert not machine.lib.exists()
    assert (machine.configs / "can0.toml").exists()


def test_two_installations_at_once_do_not_mix(machine: Machine) -> None:
    machine.make("install", builds="1.0")
    before = machine.tree()
    other = os.open(machine.lib, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    for target in ("install", "rollback", "uninstall"):
        said = machine.make(target, works=False, builds="2.0")
        assert said.startswith(f"make {target}: another one is at work in {machine.lib}")
        assert machine.tree() == before
    os.close(other)


def pins(text: str) -> dict[str, str]:
    found = re.findall(r"^([\w.-]+)==([^\s\\]+)", text, re.MULTILINE)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, version in found}


def test_the_lock_pins_every_dependency_at_the_version_that_was_tested() -> None:
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    tested = pins((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    locked = pins(lock)
    assert locked.items() <= tested.items()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {re.split(r"[<>=~!]", d)[0].lower() for d in project["dependencies"]}
    assert asked <= locked.keys()
    for entry in re.split(r"\n(?=\S)", lock)[1:]:
        assert re.fullmatch(r"[\w.-]+==\S+( \\\n    --hash=sha256:[0-9a-f]{64})+\n?", entry), entry
    assert "://" not in lock


def test_pip_refuses_a_wheel_that_is_not_the_locked_one(
    machine: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a real environment and pip: nothing of the other wheel is installed."""
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    wheel = wheels / "taxeld_dependency-1.0-py3-none-any.whl"
    wheel.write_bytes(b"another")
    lock = tmp_path / "lock"
    lock.write_text(f"taxeld-dependency==1.0 \\\n    --hash=sha256:{'0' * 64}\n", encoding="utf-8")
    machine.make("install", builds="1.0")
    before = machine.tree()
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheels))
    said = machine.make("install", works=False, PYTHON=sys.executable, LOCK=str(lock))
    assert "DO NOT MATCH THE HASHES" in said
    assert machine.tree() == before
