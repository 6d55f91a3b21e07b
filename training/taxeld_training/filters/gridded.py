"""The grid filter run through a trial: what the estimator learns from, as the estimator sees it."""

from collections.abc import Iterator
from itertools import groupby

from taxeld.config.tables import FilterConfig, SensorPoseConfig
from taxeld.estimator.intake import Intake
from taxeld.estimator.memory import Slack
from taxeld.estimator.news import News
from taxeld.estimator.rule import EstimatorCounters
from taxeld.model.observation import ObservationModel
from taxeld_training.filters.methods import NOISE
from taxeld_training.filters.trials import Trial, TrialScan
from taxeld_training.limits.grid_filter import GridFilter

SLACK = Slack(SensorPoseConfig().sigma_m, FilterConfig().nudge_m)  # the daemon's default


def after_touches(trial: Trial, model: ObservationModel) -> Iterator[tuple[TrialScan, GridFilter]]:
    """The last moment of each touch, and a grid filter that assumes the object of `model` then."""
    grid = GridFilter(model, NOISE, SLACK)
    intake, news = Intake(model, EstimatorCounters()), News(model.layout.radius_m)
    for _, moments in groupby(trial, key=lambda moment: moment.touch):
        for moment in moments:
            scan = intake.observation(moment.activation, moment.sensor)
            if scan is None or not scan.live.any():
                continue
            new = news.on_scan(moment.activation.t, scan)
            if new is not None:
                grid.update(new, touched=new.is_contact, contact=news.contacts)
        yield moment, grid
