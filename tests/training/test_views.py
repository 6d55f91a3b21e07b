"""Views: a touch looks the same from every side."""

import numpy as np
import torch

from taxeld.model import se2
from taxeld.model.observation import ObservationModel
from taxeld_training.models.dataset import SimulatedTouches, simulate
from taxeld_training.models.views import Centred, Plain, Turned, best


def tensors(h: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(h).float(), torch.ones(h.shape)


def turned_about_the_axis(pose: np.ndarray, angle: float) -> np.ndarray:
    return se2.compose(np.array([0.0, 0.0, angle]), pose)


def test_a_ring_sees_the_same_touch_at_every_column(
    ring_model: ObservationModel, touches: SimulatedTouches
) -> None:
    view = Turned(ring_model.layout)
    pose = touches.pose[:200]
    here, angle = view(*tensors(ring_model.activation(pose)))
    there, other = view(
        *tensors(ring_model.activation(turned_about_the_axis(pose, 2 * np.pi * 5 / 16)))
    )
    same = (here - there).abs().amax(dim=1) < 1e-3
    assert same.float().mean() > 0.95  # two columns may feel the same, and rounding choose
    gap = torch.remainder(other - angle, 2 * np.pi)[same]
    assert torch.allclose(gap, torch.full_like(gap, 2 * np.pi * 5 / 16), atol=1e-4)


def test_a_skin_without_symmetry_sees_nearly_the_same_touch_from_every_side(
    half_model: ObservationModel,
) -> None:
    """As the taxels lie unevenly, the window is compared by where its weight is."""
    view = best(half_model.layout)
    assert isinstance(view, Centred)
    pose = np.array([[0.068, 0.0, 0.0]])
    centres = []
    for turn in (-0.6, -0.2, 0.3, 0.7):
        seen, angle = view(*tensors(half_model.activation(turned_about_the_axis(pose, turn))))
        grid = seen[0, : view.width // 3].reshape(-1, view.rows).sum(dim=1)
        cells = torch.arange(-view.reach, view.reach + 1)
        offset = (grid * cells).sum() / grid.sum() / view.cells_per_rad
        centres.append(float(angle[0] + offset) - turn)
    assert np.ptp(centres) < 0.15


def test_the_window_keeps_every_taxel_near_the_touch(half_model: ObservationModel) -> None:
    layout = half_model.layout
    view = Centred(layout)
    z = torch.zeros(1, 60)
    z[0, 30] = 1.0
    seen, angle = view(z, torch.ones(1, 60))
    assert torch.isclose(seen[0, : view.width // 3].sum(), torch.tensor(1.0), atol=1e-5)
    direction = np.arctan2(layout.position_m[:, 1], layout.position_m[:, 0])
    near = np.abs(direction - float(angle[0])) < 0.65
    assert seen[0, -(view.width // 3) :].sum() >= near.sum() - 1e-3


def test_a_dead_taxels_reading_is_not_seen(
    ring_model: ObservationModel, half_model: ObservationModel
) -> None:
    for view, taxels in (
        (Plain(ring_model.layout), 32),
        (Turned(ring_model.layout), 32),
        (Centred(half_model.layout), 60),
    ):
        z, live = torch.zeros(1, taxels), torch.ones(1, taxels)
        z[0, 3], live[0, 7] = 0.6, 0.0
        other = z.clone()
        other[0, 7] = 1.0
        assert torch.equal(view(z, live)[0], view(other, live)[0])
        assert torch.equal(view(z, live)[1], view(other, live)[1])


def test_a_batch_of_touches_looks_as_each_of_them_alone(half_model: ObservationModel) -> None:
    """A batch goes by the few taxels that are pressed or dead, a touch by all of them."""
    view = Centred(half_model.layout)
    rng = np.random.default_rng(0)
    h = half_model.activation(simulate(half_model, 50, rng).pose)
    z, live = tensors(h)[0], torch.from_numpy(rng.random(h.shape) > 0.2).float()
    live[:10] = 1.0
    together, angles = view(z, live)
    for k in range(50):
        alone, angle = view(z[k : k + 1], live[k : k + 1])
        assert torch.equal(angle, angles[k : k + 1])
        assert torch.allclose(alone[0], together[k], atol=1e-3)  # of a root, for rounding's sake
