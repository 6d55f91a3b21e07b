"""The rules by name: how a belief learns from scans and samples of contacts."""

from collections.abc import Callable

import numpy as np

from taxeld.config.tables import FilterConfig
from taxeld.estimator.mixture import Mixture
from taxeld.estimator.paper import Paper
from taxeld.estimator.rule import Rule
from taxeld.model.observation import ObservationModel

RULES: dict[str, Callable[[ObservationModel, FilterConfig, float, np.random.Generator], Rule]] = {
    "paper": Paper,
    "mixture": Mixture,
}
