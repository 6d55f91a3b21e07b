"""The rules by name: how a belief learns from a scan and the samples that a touch brings."""

from collections.abc import Callable

import numpy as np

from taxeld.config import FilterConfig
from taxeld.mixture_rule import Mixture
from taxeld.observation import ObservationModel
from taxeld.paper_rule import Paper
from taxeld.rule import Rule

RULES: dict[str, Callable[[ObservationModel, FilterConfig, np.random.Generator], Rule]] = {
    "paper": Paper,
    "mixture": Mixture,
}
