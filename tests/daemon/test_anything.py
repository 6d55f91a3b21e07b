"""What a contact's readings are worth without the object: above chance, below the object itself."""

from dataclasses import replace

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.anything import Anything
from taxeld.layout.layout import Layout
from taxeld.model import contacts, se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Observation, ObservationModel

from ..rig.memories import memory_of, plus
from ..rig.scenes import DEPTH_MAX_M, box, scene_of

NOISE = Noise(sigma=0.04)
AT = np.zeros((1, 3))  # where the object is


def touches(model: ObservationModel, n: int) -> list[Observation]:
    """Firm presses of the object, that a noisy skin reads."""
    rng = np.random.default_rng(0)
    made = contacts.synthesise(model.scene, 0.04, DEPTH_MAX_M, 40 * n, rng).pose
    firm: Poses = made[model.activation(made).max(axis=1) > 0.4][:n]
    return [
        Observation(
            se2.inverse(pose),
            NOISE.draw(model.activation(pose[None])[0], rng),
            np.ones(len(model.layout), np.bool_),
        )
        for pose in firm
    ]


def ahead(model: ObservationModel, scan: Observation) -> float:
    """Nats by which the object where it is explains a scan better than anything."""
    known = plus(memory_of(model, NOISE), scan)
    return float(known.explain(AT)[0, 0] - known.anything[0])


def test_the_object_explains_its_contacts_better_than_anything_but_no_disorder(
    box_model: ObservationModel,
) -> None:
    scans, rng = touches(box_model, 40), np.random.default_rng(1)
    gains = [ahead(box_model, scan) for scan in scans]
    assert np.median(gains) > 4.0
    assert np.mean(np.array(gains) > 0.0) > 0.9
    mixed = [replace(scan, z=rng.permutation(scan.z)) for scan in scans]
    assert np.median([ahead(box_model, scan) for scan in mixed]) < -10.0


def test_readings_are_no_likelier_in_all_than_they_can_be(box_model: ObservationModel) -> None:
    """The mean ratio of two densities, over draws of the one below, is at most 1: also of ratios
    cut at 10, whose mean few draws tell."""
    anything, rng = Anything(box_model, NOISE), np.random.default_rng(2)
    for scan in touches(box_model, 5):
        h = box_model.activation(se2.inverse(scan.sensor)[None])[0]
        ratios = []
        for _ in range(100):
            z = NOISE.draw(h, rng)
            log_p = float(NOISE.log_density(z, h).sum())
            ratios.append(np.exp(anything.log_density(replace(scan, z=z)) - log_p))
        assert np.minimum(ratios, 10.0).mean() < 1.0


def test_what_is_felt_all_round_the_skin_is_alike(box_model: ObservationModel) -> None:
    """The shapes are the same about whatever side is touched, and the ring has 16 of them."""
    anything, layout = Anything(box_model, NOISE), box_model.layout
    for scan in touches(box_model, 10):
        turned = [anything.log_density(replace(scan, z=scan.z[turn])) for turn in layout.turns]
        assert np.ptp(turned) < 0.01


def test_a_skin_on_half_of_the_link_is_touched_from_half_as_many_sides() -> None:
    angle = np.radians(np.arange(-85.0, 90.0, 10.0))
    normal = np.stack([np.cos(angle), np.sin(angle), np.zeros(18)], axis=1)
    skin = Layout("half", np.arange(1, 19), 0.04 * normal, normal, 0.04)
    model = ObservationModel(scene_of(box(0.03, 0.06), skin, symmetry=2), skin, DEPTH_MAX_M)
    gains = [ahead(model, scan) for scan in touches(model, 20)]
    assert np.isfinite(gains).all()
    assert np.median(gains) > 2.0
