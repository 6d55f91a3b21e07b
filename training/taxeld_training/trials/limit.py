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


def play(case: Case, seed: int) -> list[Touch]:
    """The error of the grid in the trial of a seed, of one object on one link. The grid publishes
    no p. It looks at its belief after the last touch alone, as a look after each would take
    minutes. The trial's own processor time, little beside the grid's, is counted with it."""
    model = model_of(case.known[0], *case.specs)
    grid = GridFilter(model, NOISE, SLACK)
    intake, news = Intake(model, EstimatorCounters()), News(model.layout.radius_m)
    found, began_s = list[Touch](), time.process_time()
    for touch, scans in groupby(moments(case, seed), key=lambda moment: moment.touch):
        for moment in scans:
            activation, sensor = moment.outcome.activation, moment.outcome.sensor
            if activation is None or sensor is None:
                continue
            scan = intake.observation(activation, sensor)
            if scan is None or not scan.live.any():
                continue
            new = news.on_scan(activation.t, scan)
            if new is not None:
                grid.update(new, news.contacts, touched=new.is_contact)
        size = len(grid) if touch + 1 == case.touches else 0
        pose = grid.estimate() if size else moment.truth
        error_mm = round(1e3 * add_m(model.scene, pose, moment.truth)[1], 4) if size else NAN
        ms = round(1e3 * (time.process_time() - began_s), 3)
        began_s = time.process_time()
        found.append(Touch(0, error_mm, NAN, NAN, (), NAN, NAN, "", size, ms, NAN, 0.0))
    return found
