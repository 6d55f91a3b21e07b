"""The checks of the service, inside the virtual machine; a line each, and a summary.

Each is named as docs/service.md names it. They run in order, as root, on the unit as installed.
"""

import json
import os
import re
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

from touch import CONFIG, PATIENCE_S, Touch, Unit, sh, until

from taxeld import client
from taxeld.config import ControlConfig, LoopConfig
from taxeld.estimate import Status

CHECKS: list[Callable[[], str | None]] = []
VCAN0 = Unit("vcan0")
ON_VCAN0 = ("--can", "vcan0")


def check(function: Callable[[], str | None]) -> Callable[[], str | None]:
    CHECKS.append(function)
    return function


@check
def networkd_brings_can0_up_at_1_mbit_s() -> str:
    until("can0 is up", lambda: "UP" in sh("ip link show can0 up"))
    data = json.loads(sh("ip -details -json link show can0"))[0]["linkinfo"]["info_data"]
    assert data["bittiming"]["bitrate"] == 1_000_000
    assert data["restart_ms"] == 100
    return "on an emulated SJA1000"


@check
def a_device_that_comes_late_starts_its_instance() -> None:
    """And the instance that found none says so, in one line."""
    VCAN0.config.write_text(CONFIG % "vcan0", encoding="utf-8")
    sh(f"systemctl enable {VCAN0.name}; ! systemctl start {VCAN0.name}")
    assert VCAN0.show("ExecMainStatus") == "2"
    said = VCAN0.said()
    assert re.fullmatch(r"source\.channel: cannot open socketcan vcan0 .*", said), said
    sh("ip link add vcan0 type vcan")
    until(f"{VCAN0.name} is active", lambda: VCAN0.show("ActiveState") == "active")
    sh("ip link set vcan0 up")


@check
def estimates_arrive_through_socketcan_and_converge() -> str:
    with Touch(1, *ON_VCAN0) as skin:
        found = skin.wait_found()
        until("a status line that says so", lambda: "converged" in VCAN0.show("StatusText"))
    return found


@check
def the_loop_is_a_real_time_thread_with_locked_memory() -> str:
    """As it says itself, and as the kernel does."""
    answer = client.ask(ControlConfig().endpoint, "status", timeout_s=PATIENCE_S)
    assert answer is not None
    granted, wanted = answer["health"]["realtime"], LoopConfig().priority
    assert (granted["fifo"], granted["locked"]) == (wanted, True), granted
    assert os.sched_getscheduler(VCAN0.pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    assert os.sched_getparam(VCAN0.pid).sched_priority == wanted
    locked = re.search(r"VmLck:\s+(\d+) kB", Path(f"/proc/{VCAN0.pid}/status").read_text("ascii"))
    assert locked is not None
    assert int(locked[1]) > 0
    return f"FIFO {wanted}, {int(locked[1]) // 1024} MB"


@check
def a_daemon_that_hangs_is_killed_by_the_watchdog_and_converges_again() -> str:
    restarts = VCAN0.restarts()
    with Touch(2, *ON_VCAN0) as skin:
        skin.wait_felt()
        os.kill(VCAN0.pid, signal.SIGSTOP)
        VCAN0.wait_restarted(restarts)
    assert "Watchdog timeout" in VCAN0.journal()
    with Touch(3, *ON_VCAN0) as skin:
        return skin.wait_found()


@check
def a_daemon_that_is_killed_is_restarted_and_converges_again() -> str:
    restarts = VCAN0.restarts()
    with Touch(4, *ON_VCAN0) as skin:
        skin.wait_felt()
        os.kill(VCAN0.pid, signal.SIGKILL)
        VCAN0.wait_restarted(restarts)
    with Touch(5, *ON_VCAN0) as skin:
        return skin.wait_found()


@check
def an_interface_that_goes_down_and_up_is_taken_up_again() -> str:
    pid = VCAN0.pid
    with Touch(6, *ON_VCAN0) as skin:
        skin.wait_felt()
        sh("ip link set vcan0 down")
        skin.wait("a stale estimate", lambda e: e["status"] == Status.STALE)
        sh("ip link set vcan0 up")
        found = skin.wait_found()
    assert VCAN0.pid == pid
    return found


@check
def a_clock_that_is_set_an_hour_on_and_back_is_survived() -> str:
    pid = VCAN0.pid
    with Touch(7, *ON_VCAN0) as skin:
        skin.wait_felt()
        for hour in (3600.0, -3600.0):
            time.clock_settime(time.CLOCK_REALTIME, time.time() + hour)
            skin.wait(
                "fresh estimates on the new clock",
                lambda e: abs(e["t"] - time.time()) < 60.0 and e["status"] != Status.STALE,
            )
        found = skin.wait_found()
    assert VCAN0.pid == pid
    return found


@check
def a_full_disk_stops_nothing() -> str:
    VCAN0.stop()
    sh("mount -t tmpfs -o size=64k tmpfs /var/lib/taxeld && mkdir /var/lib/taxeld/vcan0")
    sh("! dd if=/dev/zero of=/var/lib/taxeld/full bs=4k")
    VCAN0.start()
    pid = VCAN0.pid
    with Touch(8, *ON_VCAN0) as skin:
        found = skin.wait_found()
    assert VCAN0.pid == pid
    VCAN0.stop()
    assert VCAN0.show("Result") == "success"
    sh("umount /var/lib/taxeld")
    return found


@check
def estimates_arrive_through_kernel_slcan_and_converge() -> str:
    VCAN0.stop()  # it has the streams' endpoints
    unit, link = Unit("slcan0"), Path("/run/skin")
    unit.config.write_text(CONFIG % "slcan0", encoding="utf-8")
    sh("ip link add slcan0 type vcan && ip link set slcan0 up")
    unit.start()
    sh("ip link del slcan0")  # it waits for the adapter, which is plugged in now
    with Touch(9, "--link", str(link)) as skin:
        sh(f"slcand -o -s8 {link.readlink()} slcan0")
        until("slcan0", Path("/sys/class/net/slcan0").exists)
        sh("ip link set slcan0 up")
        found = skin.wait_found()
        sh("ip link set slcan0 down; kill $(pidof slcand)")
    unit.stop()
    return found


@check
def a_wrong_configuration_fails_once_and_says_why() -> None:
    unit = Unit("wrong")
    unit.config.write_text('[source]\nkind = "can"\nchanel = "can0"\n[scene]\nbundle = "box"\n')
    sh(f"! systemctl start {unit.name}")
    time.sleep(5.0)  # in which it would have been restarted
    assert unit.show("ActiveState") == "failed"
    assert unit.show("ExecMainStatus") == "2"
    assert unit.restarts() == 0
    said = unit.said()
    assert re.fullmatch(r"source\.chanel: unknown key.*", said), said


@check
def inside_the_unit_only_what_it_needs_is_possible() -> str:
    sh("ip addr add 192.0.2.1/32 dev lo")  # a net beyond loopback that would answer
    sh("mknod -m 666 /dev/open_disk b $(lsblk -dno MAJ:MIN /dev/vda | tr : ' ')")
    sh("mkdir -m 777 /srv/open")
    until("the USB line", Path("/dev/ttyUSB0").exists, 30.0)
    with socket.create_server(("0.0.0.0", 0)) as server:
        port = server.getsockname()[1]
        outside = json.loads(sh(f"STATE_DIRECTORY=/tmp {sys.executable} /vm/probe.py {port}"))
        drop_in = Path("/run/systemd/system/taxeld@probe.service.d/probe.conf")
        drop_in.parent.mkdir(parents=True)
        drop_in.write_text(
            f"[Service]\nType=oneshot\nRestart=no\nExecStart=\n"
            f"ExecStart={sys.executable} /vm/probe.py {port}\n"
        )
        sh("systemctl daemon-reload; systemctl start taxeld@probe")
    inside = json.loads(next(s for s in Unit("probe").journal().splitlines() if s[:1] == "{"))
    may = {name for name, outcome in inside.items() if outcome == "may"}
    assert may == {
        "a FIFO thread", "locked memory", "connect to loopback", "a CAN socket",
        "a USB serial line", "write its state",
    }, inside  # fmt: skip
    assert int(inside["capabilities"], 16) == 0
    assert inside["uid"] != "0"
    everything = {name for name, outcome in outside.items() if outcome == "may"}
    assert everything >= set(inside) - {"uid", "capabilities"}, outside  # the unit is what forbids
    return f"{len(may)} of {len(everything)} acts"


@check
def a_usb_line_belongs_to_the_daemon_under_a_stable_name() -> None:
    line = Path("/dev/ttyUSB0")
    assert line.group() == "taxeld"
    names = [p.name for p in Path("/dev").glob("ihb_*") if p.resolve() == line]
    assert names, sh("udevadm info /dev/ttyUSB0")


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


def main() -> int:
    sh("modprobe -a vcan slcan can-raw")
    failed = 0
    for function in CHECKS:
        name = function.__name__.replace("_", " ")
        started = time.monotonic()
        try:
            note = function() or ""
        except Exception as error:  # a check that breaks has failed, and the others go on
            failed += 1
            print(f"FAILED  {name}: {type(error).__name__}: {error}")
            print(sh("journalctl -b -n 40 --no-hostname -u 'taxeld@*'"))
        else:
            took = f"{time.monotonic() - started:.0f} s"
            print(f"passed  {name} ({', '.join(filter(None, (note, took)))})")
    total = len(CHECKS)
    print(f"{failed} of {total} checks failed" if failed else f"all {total} checks passed")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
