"""Errors of an estimate."""

import numpy as np
import pytest

from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_training.filters import follow
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.trials import Trial
from taxeld_training.jobs.rows import SUCCESS_MM


def test_of_two_objects_of_one_kind_the_nearer_one_counts(
    ring_model: ObservationModel,
) -> None:
    trial = Trial(ring_model, 1, 2, Conditions(both=2))
    moment = next(iter(trial))
    assert moment.twin is not None
    beside = se2.compose(moment.twin, np.array([0.001, 0.0, 0.0]))
    errors = follow._errors(trial, ring_model, moment, beside, moment.truth)
    assert errors[:2] == pytest.approx((1.0, 0.0), abs=1e-6)
    assert errors[2] > SUCCESS_MM  # the trial means the other one
    alone = moment._replace(twin=None)
    assert follow._errors(trial, ring_model, alone, beside, moment.truth)[0] > SUCCESS_MM
