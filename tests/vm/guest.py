"""The checks of the service, inside the virtual machine; a line each, and a summary.

Situations of docs/service.md and their parts. They run in order, as root, on the unit as installed.
"""

import json
import os
import re
import signal
import socket
import sys
import time
from pathlib import Path

import checks
from checks import check
from touch import CONFIG, ON_VCAN0, PATIENCE_S, VCAN0, Touch, Unit, sh, until, vcan0_is_there

from taxeld.config.tables import ControlConfig, LoopConfig
from taxeld.estimator.estimate import Status
from taxeld.stream import client


@check
def networkd_brings_can0_up_at_1_mbit_s() -> str:
    until("can0 is up", lambda: "UP" in sh("ip link show can0 up || true"))
    data = json.loads(sh("ip -details -json link show can0"))[0]["linkinfo"]["info_data"]
    assert data["bittiming"]["bitrate"] == 1_000_000
    assert data["restart_ms"] == 100
    return "on an emulated SJA1000"


@check
def a_device_that_comes_late_is_waited_for() -> None:
    """The instance is ready without it, and says in one line what it waits for."""
    VCAN0.config.write_text(CONFIG % "vcan0", encoding="utf-8")
    sh(f"systemctl enable {VCAN0.name}")
    VCAN0.start()
    pid = VCAN0.pid
    until("a status line that says so", lambda: VCAN0.show("StatusText").startswith("waiting, "))
    said = VCAN0.said()
    reason = r"source\.channel: no CAN interface 'vcan0'; bring it up: .*; waiting for it"
    assert len(re.findall(f"^{reason}$", said, re.MULTILINE)) == 1, said
    sh("ip link add vcan0 type vcan && ip link set vcan0 up")
    until("it is opened", lambda: not VCAN0.show("StatusText").startswith("waiting, "))
    assert VCAN0.pid == pid


@check
def an_error_frame_of_the_kernels_is_said_with_its_cure_and_that_it_has_passed() -> None:
    sh("cansend vcan0 20000040#0000000000000000")
    until("bus-off is said", lambda: "source.channel: bus-off, " in VCAN0.said())
    sh("cansend vcan0 20000100#0000000000000000")  # restarted
    until("it has passed", lambda: "no longer: source.channel: bus-off, " in VCAN0.said())


@check
def estimates_arrive_through_socketcan_and_converge() -> str:
    with Touch(1, *ON_VCAN0) as skin:
        found = skin.wait_found()
        told = r", contacts [1-9]"  # no status: the skin may have ended by then
        until("a status line", lambda: re.search(told, VCAN0.show("StatusText")) is not None)
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
def a_daemon_that_hangs_or_is_killed_is_restarted_and_converges_again() -> str:
    found = []
    for number in (signal.SIGSTOP, signal.SIGKILL):
        restarts = VCAN0.restarts()
        with Touch(2, *ON_VCAN0) as skin:
            skin.wait_felt()
            os.kill(VCAN0.pid, number)
            VCAN0.wait_restarted(restarts)
        with Touch(3, *ON_VCAN0) as skin:
            found.append(skin.wait_found())
    assert "Watchdog timeout" in VCAN0.journal()
    return "; ".join(found)


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


def probed(instance: str, port: int, *settings: str) -> dict[str, str]:
    """What a process may do in the place of the daemon of an instance."""
    unit = Unit(instance)
    command = f"{sys.executable} /vm/probe.py {port}"
    unit.drop_in("Type=oneshot", "Restart=no", "ExecStart=", f"ExecStart={command}", *settings)
    unit.start()
    found: dict[str, str] = json.loads(next(s for s in unit.journal().splitlines() if s[:1] == "{"))
    return found


@check
def inside_the_unit_only_what_it_needs_is_possible() -> str:
    sh("ip addr add 192.0.2.1/32 dev lo")  # a net beyond loopback that would answer
    sh("mknod -m 666 /dev/open_disk b $(lsblk -dno MAJ:MIN /dev/vda | tr : ' ')")
    sh("mkdir -m 777 /srv/open")
    until("the USB line", Path("/dev/ttyUSB0").exists, 30.0)
    with socket.create_server(("0.0.0.0", 0)) as server:
        port = server.getsockname()[1]
        outside = json.loads(sh(f"STATE_DIRECTORY=/tmp {sys.executable} /vm/probe.py {port}"))
        inside = probed("probe", port)
        unfiltered = probed("unfiltered", port, "SystemCallFilter=")
    may = {name for name, outcome in inside.items() if outcome == "may"}
    assert may == {
        "a FIFO thread",
        "locked memory",
        "connect to loopback",
        "a CAN socket",
        "a USB serial line",
        "write its state",
    }, inside
    assert int(inside["capabilities"], 16) == 0
    assert inside["uid"] != "0"
    everything = {name for name, outcome in outside.items() if outcome == "may"}
    filtered = {name for name, outcome in unfiltered.items() if outcome == "may"} - may
    assert filtered >= {"another niceness", "another processor"}, unfiltered
    assert everything >= set(inside) - {"uid", "capabilities"}, outside  # the unit is what forbids
    return f"{len(may)} of {len(everything)} acts"


@check
def a_usb_line_belongs_to_the_daemon_under_a_stable_name() -> None:
    line = Path("/dev/ttyUSB0")
    assert line.group() == "taxeld"
    names = [p.name for p in Path("/dev").glob("ihb_*") if p.resolve() == line]
    assert names, sh("udevadm info /dev/ttyUSB0")


def main() -> int:
    # these come after the service's own; the last of them remove it
    import guest_neighbours, guest_power, guest_install  # noqa: E401, F401, I001, PLC0415

    sh("modprobe -a vcan slcan can-raw")
    wanted, outcomes = checks.asked_for(), checks.ended()
    if not wanted:
        print("no check has such a name")
    if outcomes or len(wanted) < len(checks.CHECKS):
        vcan0_is_there()
    for function in wanted:
        name = checks.named(function)
        if name in outcomes:
            continue
        started = time.monotonic()
        try:
            note = function() or ""
        except Exception as error:  # a check that breaks has failed, and the others go on
            outcomes[name] = "FAILED"
            print(f"FAILED  {name}: {type(error).__name__}: {error}")
            print(sh("journalctl -b -n 40 --no-hostname -u 'taxeld*@*' || true"))
        else:
            outcomes[name] = "passed"
            took = f"{time.monotonic() - started:.0f} s"
            print(f"passed  {name} ({', '.join(filter(None, (note, took)))})")
        checks.has_ended(name, outcomes[name])
    failed, total = list(outcomes.values()).count("FAILED"), len(outcomes)
    print(f"{failed} of {total} checks failed" if failed else f"all {total} checks passed")
    return bool(failed) or not wanted


if __name__ == "__main__":
    sys.exit(main())
