"""What `taxeld-hil expect` says of its trials: lines and `expect.json`."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from taxeld.errors import SetupError
from taxeld_hil.experiment import expect, measurement
from taxeld_hil.experiment.expect import Help, Touched
from taxeld_hil.experiment.expect_subjects import Asked
from taxeld_hil.experiment.measurement import RunRow
from taxeld_hil.integrity import FOUND_MM
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world.world import load_model


def written(asked: Asked, own: Scenario, runs: Sequence[RunRow], out: Path) -> Iterator[str]:
    """The lines, once the files are written into the directory `out`.

    Raises:
        SetupError: no trial was done, or the directory cannot be written.
    """
    trials = [run for run in runs if run["name"] == expect.AS_IS]
    if not trials:
        raise SetupError("--minutes: no run was done; give more")
    model = load_model(own)
    rows = expect.table(trials)
    changes = expect.helps(runs)
    measurement.save(
        out / "expect.json",
        runs,
        asked=asdict(asked),
        touches=[row._asdict() for row in rows],
        helps=[each._asdict() for each in changes],
    )
    yield (
        f"{asked.object} on {model.layout.name}, {len(model.layout)} taxels, foam {own.physics} of "
        f"{1e3 * model.depth_max_m:g} mm, robot {1e3 * asked.robot_m:g} mm: {len(trials)} trials"
    )
    yield ""
    yield from lines(rows, changes)
    yield str(out / "expect.json")


def lines(rows: Sequence[Touched], changes: Sequence[Help]) -> Iterator[str]:
    """A Markdown table, then a line on each thing."""
    head = ["touches", "median mm", "90 % mm", f"found (< {FOUND_MM:.0f} mm)", "found and sure"]
    yield "| " + " | ".join([*head, "misleading"]) + " |"
    yield "|---" * (len(head) + 1) + "|"
    for row in rows:
        shares = [f"{share:.0%}" for share in (row.found, row.found_and_sure, row.misleading)]
        errors = [f"{mm:.1f}" for mm in (row.median_mm, row.p90_mm)]
        yield "| " + " | ".join([str(row.touches), *errors, *shares]) + " |"
    yield ""
    for each in changes:
        found, sure = (
            f"{100 * a:.0f} -> {100 * b:.0f} %" for a, b in (each.found, each.found_and_sure)
        )
        yield (
            f"{each.verdict}: {each.name} {found} found, {sure} found and sure after {each.after} "
            f"({each.trials} seeds)"
        )
