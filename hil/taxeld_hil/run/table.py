"""The fault table of docs/results/faults.md, from the grades of shipped scenarios."""

from collections.abc import Iterable, Iterator
from typing import Any

from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario import scenario

HEAD = ("fault", "scenario", "shows in", "within", "seen after", "fresh again after its end")


def rows(seeds: Iterable[int], bundle: str = "", foam: str = "", layout: str = "") -> Iterator[str]:
    """A Markdown table: worst values over the seeds, on the fake clock; with the scenarios' own
    objects, foams and layouts where none is named.

    Raises:
        SetupError: there is no foam of that name.
    """
    yield "| " + " | ".join(HEAD) + " |"
    yield "|---" * len(HEAD) + "|"
    seeds = list(seeds)
    for name in scenario.shipped():
        subject = scenario.load(name).touching(bundle).on(foam, layout)
        if not subject.fault or name == "everything":
            continue
        runs = [FakeRun(subject, seed).graded(name).figures["faults"] for seed in seeds]
        for same in zip(*runs, strict=True):
            yield _row(name, same)


def _row(name: str, same: tuple[dict[str, Any], ...]) -> str:
    first = same[0]
    flag = f"`{first['flag'].replace(', ', '`, `')}`" if first["flag"] else "nothing"
    cells = [
        f"{first['kind']}, {first['for_s']:g} s",
        name,
        flag if first["injected"] else "real time alone",
        f"{first['within_s']:.2f} s" if first["flag"] and first["injected"] else "",
        _worst(run["detected_s"] for run in same) if first["flag"] and first["injected"] else "",
        _worst(run["recovered_s"] for run in same) if first["injected"] else "",
    ]
    return "| " + " | ".join(cells) + " |"


def _worst(values: Iterable[float | None]) -> str:
    known = list(values)
    if None in known:
        return "never"
    return f"{max(value for value in known if value is not None):.2f} s"
