"""What `taxeld-hil expect` says of its trials: lines, `expect.json` and `expect.png`."""

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
    try:
        measurement.save(
            out / "expect.json",
            runs,
            asked=asdict(asked),
            touches=[row._asdict() for row in rows],
            helps=[each._asdict() for each in changes],
        )
        draw(rows, changes, out / "expect.png")
    except OSError as error:
        raise SetupError(f"--out: {out}: cannot be written ({error.strerror})") from None
    yield (
        f"{asked.object} on {model.layout.name}, {len(model.layout)} taxels, foam {own.physics} of "
        f"{1e3 * model.depth_max_m:g} mm, robot {1e3 * asked.robot_m:g} mm: {len(trials)} trials"
    )
    yield ""
    yield from lines(rows, changes)
    yield f"{out / 'expect.json'}, {out / 'expect.png'}"


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


def draw(rows: Sequence[Touched], changes: Sequence[Help], out: Path) -> None:
    """Write the picture as PNG: errors, shares, and what would help. Raises OSError."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra)

    figure = Figure(figsize=(14.0, 3.8), layout="constrained")
    errors, shares, bars = figure.subplots(1, 3)
    n = [row.touches for row in rows]
    errors.semilogy(n, [row.median_mm for row in rows], "o-", label="median")
    errors.semilogy(n, [row.p90_mm for row in rows], "o--", label="90 %")
    errors.axhline(FOUND_MM, color="0.7", lw=0.8)
    errors.set(title="error [mm]", xlabel="touches")
    for key in ("found", "found_and_sure", "misleading"):
        label = key.replace("_", " ")
        shares.plot(n, [100.0 * getattr(row, key) for row in rows], "o-", label=label)
    shares.set(title=f"share of {rows[0].trials} trials [%]", xlabel="touches", ylim=(-3.0, 103.0))
    for one in (errors, shares):
        one.legend(fontsize=8)
    for i, each in enumerate(reversed(changes)):
        bars.plot([100.0 * share for share in each.found_and_sure], [i, i], color="0.6")
        bars.plot(100.0 * each.found_and_sure[0], i, "o", mfc="none", color="tab:blue")
        bars.plot(100.0 * each.found_and_sure[1], i, "o", color="tab:blue")
    after = changes[0].after if changes else 0
    bars.set_title(
        f"found and sure after {after} touches [%]: as it is (ring), changed (dot)", fontsize=10
    )
    bars.set(xlim=(-3.0, 103.0), ylim=(-0.5, len(changes) - 0.5 + (not changes)))
    bars.set_yticks(range(len(changes)), [each.name for each in reversed(changes)])
    figure.savefig(out, dpi=90, format="png")
