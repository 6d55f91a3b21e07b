"""The touches of trials as evidence: what the intake makes of each when it is firmest."""

from collections.abc import Iterable

from taxeld.estimator.counters import EstimatorCounters
from taxeld.estimator.intake import Intake
from taxeld.model.observation import Observation, ObservationModel
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.trials import Trial


def firmest(
    model: ObservationModel, seeds: Iterable[int], touches: int, conditions: Conditions
) -> list[Observation]:
    """Of each touch that is felt in the trials of these seeds, `touches` each."""
    found: list[Observation] = []
    for seed in seeds:
        intake = Intake(model, EstimatorCounters())
        best: dict[int, Observation] = {}
        for moment in Trial(model, seed, touches, conditions):
            seen = intake.observation(moment.activation, moment.sensor)
            if seen is None or not seen.is_contact:
                continue
            if moment.touch not in best or seen.z.sum() > best[moment.touch].z.sum():
                best[moment.touch] = seen
        found += best.values()
    return found
