"""A session in four moments: nothing felt, the first touch, the last doubt, the object found.

Above: where the object may be, seen from above. Below: the skin, unrolled.
"""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate, Status
from taxeld.layout.draw import plane
from taxeld.layout.layout import Layout
from taxeld.pipeline.pipeline import Pipeline
from taxeld.source import session
from taxeld.view.recorded import truth_of
from taxeld_hil.run.draw import NUMBERS, TAXELS, WORDS, Moment, activation_bar, legend, panel, save

import matplotlib.pyplot as plt  # isort: skip  (draw has chosen what it draws with)

SPAN = 2.6  # half of what is seen, in sizes of the object


class Shot(Moment):
    """A moment with the estimate of its scan."""

    def __init__(self, pipeline: Pipeline, estimate: Estimate, z: np.ndarray, sensor: np.ndarray):
        super().__init__()
        self.estimate, self.z, self.sensor = estimate, z, sensor
        self.particles = pipeline.estimator.rule.belief.pose.copy()
        self.map = estimate.map


def picture(directory: Path, out: Path) -> None:
    """Replay a session and write the four moments.

    Raises:
        SetupError: the session cannot be used, or its object is never found.
    """
    pipeline = open_pipeline(directory, config_file.load(directory / session.CONFIG))
    skin, scene = pipeline.skin.layout, pipeline.estimator.model.scene
    truth = truth_of(directory / session.TRUTH)
    shots = four(_shots(directory, pipeline))
    if shots is None:
        raise SetupError(
            f"{directory}: its object is not found by touch, so there is no such story"
        )
    figure, axes = plt.subplots(
        2, 4, figsize=(11, 4.6), height_ratios=(3.6, 1.0), layout="constrained",
        sharex="row", sharey="row",
    )  # fmt: skip
    for number, (title, shot) in enumerate(shots.items()):
        above, below = axes[:, number]
        panel(above, shot, skin, scene, truth, span=SPAN, estimated=number > 0)
        above.set_title(f"{title}\n{_said(shot.estimate)}", fontsize=9)
        _unrolled(below, skin, shot)
        if number:  # the rows share their axes
            above.set_ylabel("")
            below.set_ylabel("")
    shown = legend(truth is not None)
    figure.legend(handles=shown, loc="outside lower center", ncols=len(shown), fontsize=WORDS)
    activation_bar(figure, axes)
    save(figure, out)


def four(shots: list[Shot]) -> dict[str, Shot] | None:
    """The moments by their titles; None where the object is never found."""
    found = next((k for k, s in enumerate(shots) if s.estimate.status == Status.CONVERGED), None)
    touched = next((k for k, s in enumerate(shots) if s.estimate.contact), None)
    if found is None or touched is None:
        return None
    first = shots[touched].estimate.contacts
    release = next(
        (k for k, (a, b) in enumerate(pairwise(shots)) if a.estimate.contact > b.estimate.contact),
        len(shots) - 1,
    )
    deepest = max(range(touched, release + 1), key=lambda k: float(shots[k].z.sum()))
    doubted = [
        k for k in range(release, found)
        if shots[k].estimate.contact and shots[k].estimate.contacts > first
    ]  # fmt: skip
    doubt = doubted[0] if doubted else release
    while found + 1 < len(shots) and not shots[found].estimate.contact:
        found += 1
    return {
        "before any touch": shots[max(touched - 1, 0)],
        "the first touch": shots[deepest],
        "the next touch begins": shots[doubt],
        "found": shots[found],
    }


def _shots(directory: Path, pipeline: Pipeline) -> list[Shot]:
    return [
        Shot(pipeline, outcome.estimate, outcome.activation.z, outcome.sensor)
        for outcome in outcomes(directory, pipeline)
        if outcome.activation is not None and outcome.sensor is not None
    ]


def _said(e: Estimate) -> str:
    status = e.status.name.lower()
    if not e.contacts:
        return f"{status}: it may be anywhere"
    return f"{status}; its likeliest pose: {e.modes[0].weight:.0%}"


def _unrolled(axis: Axes, skin: Layout, shot: Shot) -> None:
    x, z = plane(skin.position_m, skin.radius_m)
    pressed = shot.z > 0.0
    axis.scatter(x, z, s=10, color="0.85")
    axis.scatter(x[pressed], z[pressed], c=shot.z[pressed], s=26, **TAXELS)
    half = math.pi * skin.radius_m * 1e3
    axis.set_xlim(-1.05 * half, 1.05 * half)
    axis.margins(y=0.15)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=NUMBERS)
    axis.set_xlabel("around the skin [mm]", fontsize=WORDS)
    axis.set_ylabel("z [mm]", fontsize=WORDS)
