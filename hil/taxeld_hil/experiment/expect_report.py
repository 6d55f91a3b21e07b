"""What `taxeld-hil expect` says of its trials: lines, `expect.json` and `expect.png`."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld_hil.experiment import expect, measurement
from taxeld_hil.experiment.expect import Help, Touched, Worth
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
    by_number = expect.told_by_number(trials)
    by_side = expect.told_by_side(trials, model.scene)
    changes = expect.helps(runs)
    try:
        measurement.save(
            out / "expect.json",
            runs,
            asked=asdict(asked),
            touches=[row._asdict() for row in rows],
            told_by_touch=[told._asdict() for told in by_number],
            told_by_side=[told._asdict() for told in by_side],
            helps=[each._asdict() for each in changes],
        )
        draw(rows, changes, trials, model.scene, out / "expect.png")
    except OSError as error:
        raise SetupError(f"--out: {out}: cannot be written ({error.strerror})") from None
    yield (
        f"{asked.object} on {model.layout.name}, {len(model.layout)} taxels, foam {own.physics} of "
        f"{1e3 * model.depth_max_m:g} mm, robot {1e3 * asked.robot_m:g} mm: {len(trials)} trials"
    )
    yield ""
    yield from lines(rows, by_number, by_side, changes)
    yield f"{out / 'expect.json'}, {out / 'expect.png'}"


def lines(
    rows: Sequence[Touched],
    by_number: Sequence[Worth],
    by_side: Sequence[Worth],
    changes: Sequence[Help],
) -> Iterator[str]:
    """A Markdown table, then a line on each thing."""
    head = ["touches", "median mm", "90 % mm", f"found (< {FOUND_MM:.0f} mm)", "found and sure"]
    yield "| " + " | ".join([*head, "misleading"]) + " |"
    yield "|---" * (len(head) + 1) + "|"
    for row in rows:
        shares = [f"{share:.0%}" for share in (row.found, row.found_and_sure, row.misleading)]
        errors = [f"{mm:.1f}" for mm in (row.median_mm, row.p90_mm)]
        yield "| " + " | ".join([str(row.touches), *errors, *shares]) + " |"
    yield ""
    most = sorted(by_number, key=lambda told: -told.made_sure)[:2]
    yield "told most: " + "; ".join(map(_said, most))
    if len(by_side) > 1:
        yield f"best side: {_said(by_side[0])}, of {by_side[0].touches} there"
        yield f"worst side: {_said(by_side[-1])}, of {by_side[-1].touches} there"
    for each in changes:
        found, sure = (
            f"{100 * a:.0f} -> {100 * b:.0f} %" for a, b in (each.found, each.found_and_sure)
        )
        yield (
            f"{each.verdict}: {each.name} {found} found, {sure} found and sure after {each.after} "
            f"({each.trials} seeds)"
        )


def _said(told: Worth) -> str:
    made_sure = f"{told.made_sure:.0%} become found and sure"
    return f"{told.name} halves the error {told.halvings:.1f} times, {made_sure}"


def draw(
    rows: Sequence[Touched],
    changes: Sequence[Help],
    trials: Sequence[RunRow],
    scene: Scene,
    out: Path,
) -> None:
    """Write the picture as PNG: errors, shares, what would help, and where touches told much.
    Raises OSError."""
    from matplotlib.figure import Figure  # noqa: PLC0415  (an extra)

    figure = Figure(figsize=(12.0, 7.6), layout="constrained")
    errors, shares, bars, object_ = figure.subplots(2, 2).ravel()
    n = [row.touches for row in rows]
    errors.semilogy(n, [row.median_mm for row in rows], "o-", label="median")
    errors.semilogy(n, [row.p90_mm for row in rows], "o--", label="90 %")
    errors.axhline(FOUND_MM, color="0.7", lw=0.8)
    errors.set(title="error [mm]", xlabel="touches")
    for key in ("found", "found_and_sure", "misleading"):
        label = key.replace("_", " ")
        shares.plot(n, [100.0 * getattr(row, key) for row in rows], "o-", label=label)
    shares.set(title=f"share of {len(trials)} trials [%]", xlabel="touches", ylim=(-3.0, 103.0))
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
    told = [one for run in trials for one in expect.open_gains(run)]
    object_.fill(*(1e3 * scene.outline.T), color="0.93", ec="0.6")
    if told:
        at, halvings = np.array([where for where, _ in told]), [gain.halvings for _, gain in told]
        dots = object_.scatter(*(1e3 * at.T), c=halvings, s=14, cmap="viridis", vmin=0.0, vmax=5.0)
        figure.colorbar(dots, ax=object_, label="halvings of the error")
    object_.set_aspect("equal", adjustable="datalim")
    object_.set_title("touches 2, 3, … until it is sure, object's frame [mm]", fontsize=10)
    figure.savefig(out, dpi=90, format="png")
