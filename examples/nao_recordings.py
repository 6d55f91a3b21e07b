"""Makes recordings for `taxeld-train evaluate real` of a NAO that touches its own chest and head.

    git clone https://github.com/ctu-vras/multirobot-calibration
    python nao_recordings.py multirobot-calibration recordings

Rustler et al. (Humanoids 2021) recorded them, with capacitive skin of iCub's type; the figures of
docs/real-skin.md are of commit a20f0454. They carry no licence, so give neither them nor what is
made of them away. It needs the packages of `.[train]`.

The robot's kinematics (`loadNAO.m`) say where its parts are, but not how a skin is mounted on its
part. So both mounts are fitted, on half A: where two skins touch, their nearest centres of pressure
coincide, and their normals are opposite. Each file has of T touches of an arm, in metres:

    place, normal (M, 3), radius_m   the arm's taxels that ever answered; its z is the link's axis
    on (T, M)                        which of them answered
    pose (T, 4, 4)                   the arm's frame in the frame of the touched part
    body, outwards (O, 3)            the touched part's taxels and their normals
    repeat (T,)                      number of the robot's pose: some are repeated
    is_b (T,)                        whether it is of half B, as all repeats of the pose are
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.io import loadmat
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from taxeld.layout import fit

DATASETS = "UserData/Robots/Nao/Dataset/Datasets"
QUARTER = 0.5 * np.pi
# length and offset [m], twist and first turn [rad] from joint to joint, the last to the mount
HEAD = [(0, 0.1265, 0, 0), (0, 0, -QUARTER, 0), (0, 0, 0, 0)]
LEFT = [(0, 0.1, -QUARTER, 0), (0, 0.098, QUARTER, 0), (0, 0, QUARTER, QUARTER)]
LEFT += [(0.015, 0.105, -QUARTER, 0), (0, 0, QUARTER, 0), (0, 0.05595, -QUARTER, np.pi)]
RIGHT = [*LEFT[:1], (0, -0.098, QUARTER, 0), LEFT[2], (-0.015, *LEFT[3][1:]), *LEFT[4:]]
PARTS = {"torso": ([], []), "head": (HEAD, ["HeadYaw", "HeadPitch"])}
JOINTS = ["ShoulderPitch", "ShoulderRoll", "ElbowYaw", "ElbowRoll", "WristYaw"]
FAR = {"rightArm": "leftArm", "leftArm": "rightArm", "torso": "head", "head": "torso"}
SAME_RAD = 0.01  # joints nearer than this repeat a pose
INSIDE_M = (0.05, 0.0, 0.0)  # from the inside of a part to the middle of its skin
ROUNDS = [0.0] * 8 + [0.02] * 8  # weight of the normals in each [m]: first the places alone
GAP_M = 0.005  # a larger gap pulls less


def chain(links: list[tuple[float, ...]], joints: np.ndarray) -> np.ndarray:
    """(T, 4, 4) poses of a mount in the robot's frame, at joints (T, J)."""
    made = np.tile(np.eye(4), (len(joints), 1, 1))
    turns = np.column_stack([np.zeros(len(joints)), joints]).T
    for (length, offset, twist, first), turn in zip(links, turns, strict=bool(links)):
        step = np.tile(np.eye(4), (len(joints), 1, 1))
        about_z = Rotation.from_rotvec(np.outer(turn + first, [0.0, 0.0, 1.0]))
        step[:, :3, :3] = (about_z * Rotation.from_rotvec([twist, 0.0, 0.0])).as_matrix()
        step[:, :3, 3] = about_z.apply([length, 0.0, offset])
        made = made @ step
    return made


def mounted(p: np.ndarray) -> np.ndarray:
    """(4, 4) a mount by its 6 parameters: a turn's vector, and a shift."""
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = Rotation.from_rotvec(p[:3]).as_matrix(), p[3:]
    return made


def fitted(sides: list[tuple[np.ndarray, ...]], half_a: np.ndarray) -> np.ndarray:
    """(12,) parameters of both mounts. Each side has its mount's poses (T, 4, 4), and centres of
    pressure with the normals there (T, n, 3)."""

    def gaps(p: np.ndarray) -> np.ndarray:
        """(T, n, m, 6) between all centres, and sums of their normals."""
        placed = []
        for (mount, centre, normal), own in zip(sides, np.split(p, 2), strict=True):
            pose = mount @ mounted(own)
            turned = [np.einsum("tij,tkj->tki", pose[:, :3, :3], v) for v in (centre, normal)]
            placed.append((turned[0] + pose[:, None, :3, 3], turned[1]))
        (a, a_normal), (b, b_normal) = ((v[:, :, None], n[:, :, None]) for v, n in placed)
        both = a - b.swapaxes(1, 2), a_normal + b_normal.swapaxes(1, 2)
        return np.concatenate(both, axis=-1)

    found, each = np.zeros(12), np.flatnonzero(half_a)
    for weight_m in ROUNDS:
        made = gaps(found)[each].reshape(len(each), -1, 6)
        nearest = np.linalg.norm(made[..., :3], axis=-1).argmin(axis=1)
        scale = np.repeat([1.0, weight_m], 3) / GAP_M

        def off(p: np.ndarray, nearest: np.ndarray = nearest, scale: Any = scale) -> np.ndarray:
            made = gaps(p)[each].reshape(len(each), -1, 6)
            return (made[np.arange(len(each)), nearest] * scale).ravel()

        found = least_squares(off, found, loss="soft_l1").x
    return found


def centres(touches: list[Any], place: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, ...]:
    """Centres of pressure and the normals there (T, n, 3); a touch with fewer has some again."""
    found = [np.atleast_2d(touch.copsUn) for touch in touches]
    most = np.arange(max(map(len, found)))
    centre = np.array([each[most % len(each)] for each in found])
    near = np.linalg.norm(centre[:, :, None] - place, axis=-1).argmin(axis=-1)
    return centre, normal[near]


def taxels(touches: list[Any]) -> tuple[np.ndarray, ...]:
    """Numbers, places and normals of the taxels that answered."""
    rows = np.vstack([np.atleast_2d(touch.activatedUn) for touch in touches])
    number, first = np.unique(rows[:, 3], return_index=True)
    return number, rows[first, :3], fit.normals(rows[first, :3])


def convert(folder: Path, arm: str, part: str) -> dict[str, Any]:
    """The recording of an arm and the part that it touches."""

    def touches(one: str, name: str, side: str) -> list[Any]:
        with (folder / f"{one}_{name}.mat").open("rb") as file:
            return [*loadmat(file, squeeze_me=True, struct_as_record=False)[side]]

    of_arm, of_part, (links, names) = touches(arm, part, arm), touches(arm, part, part), PARTS[part]
    own = [f"{arm[0].upper()}{name}" for name in JOINTS]
    joints = np.array([[getattr(t.angles, n) for n in own + names] for t in of_arm], float)
    repeat = fcluster(linkage(joints, "single"), SAME_RAD, "distance") - 1
    is_b = (np.random.default_rng(0).permutation(repeat.max() + 1) % 2 == 1)[repeat]
    number, place, normal = taxels(of_arm + touches(arm, FAR[part], arm))
    _, body, outwards = taxels(of_part + touches(FAR[arm], part, part))
    outwards *= np.sign(((body - body.mean(axis=0) + INSIDE_M) * outwards).sum(axis=1))[:, None]
    one = chain(RIGHT if arm == "rightArm" else LEFT, joints[:, :5])
    other = chain(links, joints[:, 5:])
    sides = [(one, *centres(of_arm, place, normal)), (other, *centres(of_part, body, outwards))]
    of_one, of_other = map(mounted, np.split(fitted(sides, ~is_b), 2))
    own_frame = fit.cylinder(place, normal)
    turn, shift = own_frame.frame[:3, :3], own_frame.frame[:3, 3]
    pose = np.linalg.inv(other @ of_other) @ one @ of_one @ np.linalg.inv(own_frame.frame)
    on = np.array([np.isin(number, np.atleast_2d(touch.activatedUn)[:, 3]) for touch in of_arm])
    made = {"place": place @ turn.T + shift, "normal": normal @ turn.T, "on": on, "pose": pose}
    made |= {"body": body, "outwards": outwards, "repeat": repeat, "is_b": is_b}
    return {**made, "radius_m": own_frame.radius_m}


def main(repository: str, out: str) -> None:
    Path(out).mkdir(parents=True, exist_ok=True)
    for arm in ("left", "right"):
        for part in PARTS:
            path = Path(out) / f"{arm}_arm_{part}.npz"
            made = convert(Path(repository) / DATASETS, f"{arm}Arm", part)
            np.savez_compressed(path, **made)
            print(f"{path}: {len(made['on'])} touches")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except OSError as error:
        sys.exit(str(error))
