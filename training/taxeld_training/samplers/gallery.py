"""`taxeld-train evaluate gallery`: contacts sampled for one touch (the paper's Fig. 1)."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.proposals.analytic import ANALYTIC
from taxeld_training.jobs.jobs import Job
from taxeld_training.jobs.options import Options, run_jobs
from taxeld_training.limits import quality
from taxeld_training.models import variants
from taxeld_training.models.variants import Variant
from taxeld_training.samplers import experiment, measured
from taxeld_training.samplers.experiment import Measurement
from taxeld_training.samplers.runs import reference_file, settings

OBJECT, COLUMNS = "025_mug", (16,)
READINGS = 8  # of which the strongest is drawn


def run(options: Options) -> list[Path]:
    """The picture, of the only object named or of the mug."""
    from taxeld_training.charts import gallery  # noqa: PLC0415  # matplotlib is not needed to train

    name = options.objects[0] if len(options.objects) == 1 else OBJECT
    cell = settings(replace(options, objects=(name,)), COLUMNS)[0]
    cell = replace(cell, readings=READINGS)
    path = reference_file(cell, options.memory.resolve())
    job = Job(f"gallery-{cell.name}", draw, (cell, variants.diffusion(), measured.code()), (path,))
    drawn = run_jobs([job], options)[job.name]
    panels = {key: np.array(drawn[key]) for key in ("projection", "ddpm", "exact posterior")}
    options.out.mkdir(parents=True, exist_ok=True)
    picture = options.out / "gallery.png"
    gallery.gallery(cell.model(), panels, np.array(drawn["z"]), np.array(drawn["truth"]), picture)
    return [picture]


def draw(setting: Measurement, variant: Variant, code: str, reference: str) -> dict[str, Any]:
    """Samples by three samplers for the strongest of the readings."""
    model = setting.model()
    measured.make_reference(setting, code, reference)
    to = quality.load(Path(reference))
    i = int(np.argmax([z.max() for z in to.z]))
    rng = np.random.default_rng(setting.seed)
    projection = ANALYTIC["projection"](model)
    learned = next(experiment.samplers_of(setting, "", variant, model)).sampler
    z, live = to.z[i], to.live[i]
    return {
        "z": z.tolist(),
        "truth": to.truth[i].tolist(),
        "projection": projection.propose(z, live, quality.SAMPLES, rng).tolist(),
        "ddpm": learned.propose(z, live, quality.SAMPLES, rng).tolist(),
        "exact posterior": to.exact[i][: quality.SAMPLES].tolist(),
    }
