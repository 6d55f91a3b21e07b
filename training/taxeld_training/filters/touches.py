"""The touches of trials as evidence: what the intake makes of each when it is firmest."""

from taxeld.arrays import Poses
from taxeld.estimator.intake import EstimatorCounters, Intake
from taxeld.model import se2
from taxeld.model.observation import Observation, ObservationModel
from taxeld_training.filters.cells import SEEDS_APART, TOUCHES
from taxeld_training.filters.conditions import Conditions
from taxeld_training.filters.trials import Trial


def firmest(
    model: ObservationModel, seed: int, trials: int, given: Conditions
) -> list[tuple[Poses, Observation]]:
    """Of each touch that is felt in as many trials: the object's pose (3,) in the sensor frame at
    the firmest scan, and that scan."""
    found: list[tuple[Poses, Observation]] = []
    for own in range(SEEDS_APART * seed, SEEDS_APART * seed + trials):
        intake = Intake(model, EstimatorCounters())
        best: dict[int, tuple[Poses, Observation]] = {}
        for moment in Trial(model, own, TOUCHES, given):
            seen = intake.observation(moment.activation, moment.sensor)
            if seen is None or not seen.is_contact:
                continue
            if moment.touch not in best or seen.z.sum() > best[moment.touch][1].z.sum():
                pose = se2.compose(se2.inverse(moment.sensor), moment.truth)
                best[moment.touch] = pose, seen
        found += best.values()
    return found
