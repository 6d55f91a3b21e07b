"""The values of `/taxeld/health`: what each is, and what to do where one that has a cure is not 0.

Nothing else is published there; docs/stream.md has this table, `taxeld status` the cures.
"""

import re
from collections.abc import Iterator
from typing import Any

TABLE = """
`uptime_s` | float | time since start
`loop.{overruns,own_overruns}` | int | periods (`1 / loop.rate_hz`) missed; passes with more CPU \
time than a period → [what to set](small-computers.md#what-to-set)
`lat_us.total.{p50,p99,max}` | float | time of a scan, without second opinions: percentiles of the \
last 4096, the longest since start
`realtime.fifo` | int | SCHED_FIFO priority; 0: not permitted, or not asked for
`realtime.locked` | bool | memory stays in RAM
`source.{frames,packets,bytes}` | int | received; good packets; of a serial line, received
`source.dropped.*` | int | frames that were not used, by cause: checksum or length of the packet \
wrong, its first frame missing, not from the skin → the log; of a bus: cable, terminators, bit rate
`source.{crc_errors,length_errors}` | int | packets with a wrong checksum, of a wrong length → \
cable, terminators, bit rate
`source.{index_errors,malformed,unknown,undeclared}` | int | packets: beyond the declared modules, \
malformed, of an unknown command, of undeclared or refused hubs → `source.modules`, the log
`source.scans` | int | scans
`source.{incomplete,missed}` | int | without some module, missing → the hub's supply; a longer \
`source.period_ms`
`source.{lost,unopened,unsent}` | int | the device disappeared, could not be opened, took no \
request in time → the log
`source.bus.*` | int | faults of a CAN bus that came: \
[a sick bus](troubleshooting.md#the-bus-is-sick)
`skin.{scans,learning}` | int | scans that reached it, before any baseline
`skin.unmapped` | int | scans of modules outside the layout → `skin.layout`
`skin.lowered` | int | baselines that were too high → leave the skin untouched at start; \
`taxeld tare`
`skin.gain` | float | median of the [learned gains](skin.md#what-touches-teach); far from 1: \
`skin.full_scale_counts` is wrong
`estimator.{scans,updates}` | int | scans that reached it, that changed the belief
`estimator.stuck` | int | scans with a taxel that never changes → `stuck_taxels`
`estimator.jumps`, `inputs.scans_without_pose` | int | scans after a jump of the sensor; without a \
pose near in time → [the sensor's pose](troubleshooting.md#the-sensors-pose-is-missing)
`inputs.{scans_old,scans_from_the_future}` | int | scans too old, later than now → the machine's \
load; its clock
`inputs.{scans_waiting,poses}` | int | scans that wait for a pose now; poses taken
`inputs.{poses_rejected,poses_malformed}` | int | times that do not increase or are later than \
now, places beyond 10 m; no poses → [the sensor's \
pose](troubleshooting.md#the-sensors-pose-is-missing)
`inputs.{poses_rate_hz,poses_age_s,poses_offset_s}` | float | their rate; time since the last, -1 \
without one; least delay behind this clock
`inputs.clock_steps` | int | this clock was set → chrony that slews
`calibration.age_s` | float | age of [a calibration](calibration.md), which should be under 180 \
days; -1 without one
`door.starts` | int | starts of the door; the log has the reasons
`door.unsent` | int | messages that the door did not take in time → the machine's load
`door.failed` | int | packets and changes that raised an exception → a fault of the daemon: report \
the line in its log
`door.keys_refused` | int | peers without an authorised [key](#keys), since the door's start → \
mend that client
`door.unbound` | int | TCP endpoints that cannot be bound now → the log
`recording.dropped` | int | of `taxeld run --record`: not written → a faster or emptier disk
`recording.failed` | bool | the recording has ended → the log
`modules.{layout,foreign}`, `missing_modules[]` | int | modules of the layout; that only the hubs \
have; serial numbers (SUI) that no hub has named: `skin.layout`, cables, `skin.missing_modules`
`dead_taxels[]` | int | all that cannot be trusted
`{stuck_taxels[],saturated_taxels[],untared_taxels[]}` | int | that never change, read too much, \
have no baseline → mend them; `taxeld tare`
"""


def expanded(key: str) -> list[str]:
    """`a.{b,c}` → `a.b` and `a.c`."""
    head, brace, rest = key.partition("{")
    if not brace:
        return [key]
    names, _, tail = rest.partition("}")
    return [head + name + more for name in names.split(",") for more in expanded(tail)]


def _cures() -> Iterator[tuple[str, str]]:
    for row in TABLE.strip().splitlines():
        keys, _, what = row.split(" | ")
        cure = what.partition(" → ")[2].replace("`", "")
        for key in re.findall("`(.*?)`", keys):
            for name in expanded(key):
                yield name.removesuffix("[]"), re.sub(r"\[(.*?)\]\((.*?)\)", r"\1: docs/\2", cure)


CURES = dict(_cures())  # the cure of each value, where there is one


def cure(name: str) -> str | None:
    """What to do where it is not 0, empty where there is nothing; None: not in the table."""
    return CURES.get(name, CURES.get(f"{name.rpartition('.')[0]}.*"))


def published(counted: dict[str, Any], path: str = "") -> dict[str, Any]:
    """All of `counted` that is in the table; `links` has a map of each link."""
    found: dict[str, Any] = {}
    for key, value in counted.items():
        name = path + key
        if name == "links":
            found[key] = {link: published(each) for link, each in value.items()}
        elif isinstance(value, dict):
            found[key] = published(value, f"{name}.")
        elif cure(name) is not None or name == "why":  # of a link
            found[key] = value
    return found


def amiss(health: dict[str, Any], path: str = "") -> Iterator[str]:
    """Each value that is not 0 and has a cure, with it."""
    for key, value in health.items():
        name = path + key
        if isinstance(value, dict) and name != "links":
            yield from amiss(value, f"{name}.")
        elif value and (advice := cure(name)):
            told = ", ".join(map(str, value)) if isinstance(value, list) else int(value)
            yield f"{name} {told}: {advice}"
