"""Contact coordinates: they give back the pose, and mean what they are documented to."""

import numpy as np
import pytest
import torch

from taxeld.arrays import Poses
from taxeld.model import contacts
from taxeld.model.observation import ObservationModel
from taxeld_training.models.dataset import SimulatedTouches
from taxeld_training.models.frames import ContactFrame, PoseFrame, rotated


def poses(four: torch.Tensor) -> Poses:
    x, y, c, s = four.double().numpy().T
    return np.column_stack([x, y, np.arctan2(s, c)])


def worst_mm(a: Poses, b: Poses) -> float:
    return 1e3 * float(np.hypot(*(a - b)[:, :2].T).max())


@pytest.mark.parametrize("kind", [ContactFrame, PoseFrame])
def test_a_pose_is_recovered_from_its_coordinates(
    kind: type, ring_model: ObservationModel, touches: SimulatedTouches
) -> None:
    frame = ContactFrame(ring_model) if kind is ContactFrame else PoseFrame()
    back = poses(frame.decode(frame.features(frame.encode(touches.pose))))
    assert worst_mm(back, touches.pose) < 0.5
    assert np.abs(np.sin(back[:, 2] - touches.pose[:, 2])).max() < 0.02


@pytest.mark.parametrize("kind", [ContactFrame, PoseFrame])
def test_turning_coordinates_turns_the_pose(
    kind: type, ring_model: ObservationModel, touches: SimulatedTouches
) -> None:
    frame = ContactFrame(ring_model) if kind is ContactFrame else PoseFrame()
    angle = torch.linspace(-3.0, 3.0, 500)
    turned = frame.turned(frame.encode(touches.pose[:500]), angle)
    back = poses(rotated(frame.decode(frame.features(turned)), angle))
    assert worst_mm(back, touches.pose[:500]) < 0.5


def test_a_pose_presses_as_deep_as_its_depth_coordinate(ring_model: ObservationModel) -> None:
    frame = ContactFrame(ring_model)
    s = torch.linspace(0.0, 1.0, 400)
    depth = torch.full_like(s, 0.003)
    made = poses(frame.pose(s, torch.linspace(-3.0, 3.0, 400), depth))
    gap = contacts.clearance(ring_model.scene, ring_model.layout.radius_m, made)
    assert np.abs(gap + 0.003).max() < 2e-4


def test_the_direction_is_where_the_skin_is_pressed(
    ring_model: ObservationModel, touches: SimulatedTouches
) -> None:
    direction = ContactFrame(ring_model).encode(touches.pose)[:, 1].numpy()
    xy = ring_model.layout.position_m[:, :2]
    strongest = touches.activation.argmax(axis=1)
    pressed = np.arctan2(xy[strongest, 1], xy[strongest, 0])
    off = np.abs(np.angle(np.exp(1j * (pressed - direction))))
    assert np.quantile(off, 0.99) < 2.0 * np.pi / 16
