"""The check of a power cut: the machine goes off in the middle of it, and it goes on afterwards."""

import json
import re
import subprocess
import time
from pathlib import Path

import checks
from checks import check
from touch import COMMAND, ON_VCAN0, VCAN0, Touch, frame_times, recording, sh, until

from taxeld.source import recorder

BEGUN = Path("/vm/begun")  # the session that is being recorded, and a time from which it must go on
RECORDED_S = 3.0 * recorder.SYNC_S
LOST_S = recorder.SYNC_S + 2.0  # an emulated processor is late by some


def record_until_the_power_is_cut() -> None:
    """What is on the disk then is what was synced: the kernel stores little by itself."""
    sh("sysctl -q vm.dirty_writeback_centisecs=360000")  # with 0 it would at once
    where = recording()
    with Touch(31, *ON_VCAN0) as skin:
        skin.wait_felt()
        began_s = time.time()
        checks.store(BEGUN, json.dumps([str(where), began_s]))
        until("a recording", lambda: frame_times(where)[-1] > began_s + RECORDED_S)
        checks.cut_the_power()


@check
def a_power_cut_costs_a_recording_its_last_seconds_alone() -> str:
    """It replays to its last record, and the instance is back by itself."""
    if not BEGUN.exists():
        record_until_the_power_is_cut()
    name, began_s = json.loads(BEGUN.read_text("ascii"))
    times = frame_times(Path(name))
    assert times, "not a frame of it is left"
    assert times[-1] > began_s + RECORDED_S - LOST_S, f"up to {times[-1] - began_s:.1f} s"
    done = subprocess.run([COMMAND, "replay", name], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    cut = rf"({name}: the recording was cut; used are \d+ records, .*\n)?"
    assert re.fullmatch(cut, done.stderr), done.stderr
    *_, last = map(json.loads, done.stdout.splitlines())
    assert times[-1] - last["t"] < 1.0
    until("the instance is back", lambda: VCAN0.show("ActiveState") == "active")
    return f"{times[-1] - began_s:.1f} s of at least {RECORDED_S:g}"
