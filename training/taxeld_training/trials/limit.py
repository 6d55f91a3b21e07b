"""The limit of filters: the grid filter in a trial, which learns from what an estimator does."""

import math
import time
from itertools import groupby

from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.memory import Slack
from taxeld.estimator.news import EstimatorCounters, Intake, News
from taxeld.estimator.scans import noise_of
from taxeld.model.symmetry import add_m
from taxeld_hil.trials.case import Case
from taxeld_hil.trials.play import Touch, moments
from taxeld_hil.world.subjects import model_of
from taxeld_training.limits.grid_filter import GridFilter

NOISE = noise_of(FilterConfig())
SLACK = Slack(SensorPoseConfig().sigma_m, FilterConfig().nudge_m)
NAN = math.nan
UNTOLD = Touch(0, NAN, NAN, NAN, (), NAN, NAN, "", 0, NAN, NAN, 0.0)


def play(case: Case, seed: int) -> list[Touch]:
    """The errors of the trial by the grid, which publishes no p. It looks at its belief after the
    last touch alone: a look after each would take minutes. The trial's own processor time, little
    beside the grid's, is counted with it."""
    model = model_of(case.known[0], *case.specs)
    grid = GridFilter(model, NOISE, SLACK)
    intake, news = Intake(model, EstimatorCounters()), News(model.layout.radius_m)
    found, began_s = list[Touch](), time.process_time()
    for touch, moments_of in groupby(moments(case, seed), key=lambda moment: moment.touch):
        for moment in moments_of:
            felt, sensor, new = moment.outcome.activation, moment.outcome.sensor, None
            if felt is None or sensor is None:
                continue
            scan = intake.observation(felt, sensor)
            if scan is not None and scan.live.any():
                new = news.on_scan(felt.t, scan)
            if new is not None:
                grid.update(new, touched=new.is_contact, contact=news.contacts)
        size = len(grid) if touch + 1 == case.touches else 0
        error = NAN
        if size:
            error = 1e3 * add_m(model.scene, grid.estimate()[0], moment.truth)[1]
        spent_ms = 1e3 * (time.process_time() - began_s)
        found.append(UNTOLD._replace(error_mm=error, particles=size, ms=spent_ms))
        began_s = time.process_time()
    return found
