"""A stand-in for recordings of a real skin, made from figures of theirs and from no copied data:
which taxels answer, from how far outside, how well the robot knows its arm, and repeats of poses.
"""

from pathlib import Path

import numpy as np

from taxeld.arrays import Floats

RADIUS_M, LENGTH_M, TAXELS = 0.038, 0.09, 230
ANSWERS = 1.0, 0.5  # of a beta distribution: share of the presses that a taxel answers
COVER_M = 0.0015  # taxels answer from so far outside the part's taxels
FALSE = 0.01  # share of the other taxels that answer
ROBOT_M, TILT_RAD = 0.002, 0.1  # sd of the arm's place and of its tilt, in each direction
POSES, REPEATS = 160, 2
PARTS = {"torso": (0.05, 0.09, 0.09), "head": (0.06, 0.055, 0.07)}  # half axes of ellipsoids


def write(folder: Path, arm: str = "left_arm", seed: int = 0) -> Floats:
    """Write ARM_torso.npz and ARM_head.npz; → (M,) the share of presses that each taxel answers."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-np.pi, np.pi, TAXELS)
    normal = np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])
    place = RADIUS_M * normal + [0.0, 0.0, 1.0] * rng.uniform(-0.5, 0.5, (TAXELS, 1)) * LENGTH_M
    share = rng.beta(*ANSWERS, TAXELS)
    for part, axes in PARTS.items():
        out = rng.standard_normal((4000, 3))
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        body = (out * axes)[out[:, 0] > 0.3][:200]
        pose = np.tile(np.eye(4), (POSES, 1, 1))
        side, high = rng.uniform(-1.0, 1.0, POSES), rng.uniform(-0.015, 0.015, POSES)
        across = np.column_stack([np.cos(side), np.sin(side), 0.0 * side])
        gap = RADIUS_M - rng.uniform(0.001, 0.004, POSES)
        outwards = across / axes / np.linalg.norm(across / axes, axis=1, keepdims=True)
        pose[:, :3, 3] = across * axes + gap[:, None] * outwards + high[:, None] * [0.0, 0.0, 1.0]
        z = np.column_stack([rng.normal(0.0, TILT_RAD, (POSES, 2)), np.ones(POSES)])
        z -= (z * outwards).sum(axis=1, keepdims=True) * outwards
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        x = np.cross(z, rng.standard_normal((POSES, 3)))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        pose[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
        repeat = np.repeat(np.arange(POSES), REPEATS)
        pose = pose[repeat]
        at = np.einsum("tij,mj->tmi", pose[:, :3, :3], place) + pose[:, None, :3, 3]
        scaled = np.linalg.norm(at / axes, axis=2)
        gap_m = (scaled - 1.0) * np.linalg.norm(at, axis=2) / scaled
        likely = np.where(gap_m < COVER_M, share, FALSE)
        pose[:, :3, 3] += rng.normal(0.0, ROBOT_M, (POSES, 3))[repeat]
        facing = body / np.square(axes)
        np.savez(
            folder / f"{arm}_{part}.npz",
            place=place,
            normal=normal,
            radius_m=RADIUS_M,
            on=rng.random(likely.shape) < likely,
            pose=pose,
            body=body,
            outwards=facing / np.linalg.norm(facing, axis=1, keepdims=True),
            repeat=repeat,
            is_b=repeat % 2 == 1,
        )
    return share
