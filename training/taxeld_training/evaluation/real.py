"""Trials with recordings of real skins: a robot's arm touches another part of its own body.

`examples/nao_recordings.py` makes the recordings and says what they hold; ARM_PART.npz is of an arm
and the part that it touches. What is learned of an arm's skin, from all its recordings, is learned
on half A and judged on half B. A trial draws touches of half B, each of another pose of the robot.

Readings are binary: a taxel that answers reads `READ`, give or take `SIGMA`, as it says that it is
pressed and not how deep. The part is planar: all arms whose axis is within a tilt of one direction,
the part's upright, are taken to stand upright, and their heights are rounded to `BAND_M`.
"""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import trimesh
from scipy.optimize import minimize
from scipy.special import expit

from taxeld.arrays import Bools, Floats, Index, Poses
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.estimator.bank import Known
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.model import se2
from taxeld.model.noise import Noise
from taxeld.model.observation import Activation, ObservationModel
from taxeld.model.response import SAG_M, SAG_SD
from taxeld.model.symmetry import add_m
from taxeld.prior import PosePrior
from taxeld.proposals.analytic import Table
from taxeld_sim import jobs
from taxeld_sim.answers.played import Played, touches_of, without_nan
from taxeld_sim.answers.questions import Question, Selection
from taxeld_sim.jobs import Job
from taxeld_sim.objects import scenes
from taxeld_sim.trials.case import OWN_SEEDS, code
from taxeld_sim.trials.play import Touch, touch_of

# the touched part, the known ones, the tilt, the prior, and the number of touches
Variant: TypeAlias = tuple[str, tuple[str, ...], float, str, int]

READ, SIGMA = 0.5, 0.3  # of a taxel that answers
ROBOT_M = 0.004  # sd of the arm's place: gaps of half A are 3.6 to 5.8 mm, in three directions
BAND_M, BANDS = 0.01, 5  # heights of arms, about the median
NEAR_RAD = 0.1  # arms so near to the upright are counted to find it
BACK_M = 0.07  # a part without skin behind is closed by half an ellipsoid of this depth
LAYERS = 0.3, 0.6, 0.8, 0.9, 0.97  # of it
FAR_M = 0.02  # depth beyond which the truth errs
SHARES = 0.01, 0.99  # of answers, at least and at most
LEAST_SHARE, USUAL = 0.03, (0.6, 0.4)  # least share of a live taxel; answers and silences before
# covariance of a prior: 2 cm, and 0.4 rad, which are 2 cm at the radius of a part
PRIOR = (4e-4, 0.0, 0.0), (0.0, 4e-4, 0.0), (0.0, 0.0, 0.16)
SPREAD_M = 0.2  # where parts stand in their trials
PRESSED_S, RELEASED_S = (0.0, 0.05, 0.1), (0.15, 0.45)  # times of a touch's scans
VARIANTS = (  # what the filter knows, whether that is touched, and its prior
    ("one", "known", "none"),
    ("one", "known", "2 cm"),
    ("one", "stranger", "none"),
    ("both", "known", "none"),
)


@dataclass(frozen=True, eq=False)
class SkinRecording:
    """T touches of a part by an arm with M taxels. Its planar frame is the part's: upright is z."""

    place: Floats  # (M, 3) in the arm's frame, whose z is the link's axis
    normal: Floats  # (M, 3)
    radius_m: Floats  # ()
    on: Bools  # (T, M) which taxels answered
    pose: Floats  # (T, 4, 4) of the arm in the part's frame
    body: Floats  # (O, 3) taxels of the part
    outwards: Floats  # (O, 3) their normals
    repeat: Index  # (T,) number of the robot's pose
    is_b: Bools  # (T,) whether it is of half B

    @classmethod
    def read(cls, path: Path) -> "SkinRecording":
        """Raises SetupError."""
        try:
            with np.load(path) as file:
                return cls(**{name: file[name] for name in cls.__dataclass_fields__})
        except (OSError, KeyError, ValueError) as error:
            cure = "make it by examples/nao_recordings.py"
            raise SetupError(f"--data: {path} is no recording ({error}); {cure}") from None

    @cached_property
    def upright(self) -> Floats:
        """(3,) the direction of arms near which most of the robot's poses are."""
        axis = self.pose[:, :3, 2]
        near = axis @ axis.T > np.cos(NEAR_RAD)
        most = max(near, key=lambda row: len(np.unique(self.repeat[row])))
        mean = axis[most].mean(axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    @cached_property
    def turn(self) -> Floats:
        """(3, 3) from the part's frame to its planar one."""
        x = np.cross(self.upright, self.outwards.mean(axis=0))
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(self.upright, x), self.upright])

    @cached_property
    def arms(self) -> Floats:
        """(T, 3, 4) poses of the arm in the planar frame."""
        return np.asarray(self.turn @ self.pose[:, :3])

    @property
    def sensors(self) -> Poses:
        """(T, 3) the same, as if arms stood upright."""
        arms = self.arms
        return np.column_stack([arms[:, :2, 3], np.arctan2(arms[:, 1, 0], arms[:, 0, 0])])

    @property
    def tilt(self) -> Floats:
        """(T,) of arms [rad]."""
        return np.asarray(np.arccos(np.clip(self.arms[:, 2, 2], -1.0, 1.0)))

    @cached_property
    def height_m(self) -> float:
        return float(np.median(self.arms[self.tilt < NEAR_RAD, 2, 3]))  # near the upright

    @property
    def band(self) -> Index:
        """(T,) of each arm's height; below 0 or from `BANDS` on it is too far off."""
        above = (self.arms[:, 2, 3] - self.height_m) / BAND_M + 0.5 * BANDS
        return np.floor(above).astype(np.intp)

    def drawn(self, tilt: float, seed: int) -> tuple[Poses, Index]:
        """The trial of a seed: where the part stands (3,), and touches (n,) of half B."""
        rng = np.random.default_rng(seed)
        truth = np.append(rng.uniform(-SPREAD_M, SPREAD_M, 2), rng.uniform(-np.pi, np.pi))
        fits = self.is_b & (self.tilt < tilt) & (self.band >= 0) & (self.band < BANDS)
        at = rng.permutation(np.flatnonzero(fits))
        _, first = np.unique(self.repeat[at], return_index=True)  # each of another pose
        return truth, at[np.sort(first)]

    def layout(self) -> Layout:
        """The arm once at each height, as a scan has one height."""
        m = len(self.place)
        lift = BAND_M * (np.arange(BANDS) - 0.5 * (BANDS - 1))
        place = self.place + np.multiply.outer(lift, [0.0, 0.0, 1.0])[:, None]
        uid = (np.arange(BANDS * m) // 10 + 1) << 4 | (np.arange(BANDS * m) % 10 + 1)
        normal = np.tile(self.normal, (BANDS, 1))
        return Layout("arm", uid, place.reshape(-1, 3), normal, float(self.radius_m))

    def mesh(self, cover_m: float) -> trimesh.Trimesh:
        """The part in its planar frame: the convex hull of its skin with a cover, and a back."""
        middle, out = self.body.mean(axis=0), self.outwards.mean(axis=0)
        front = self.body + cover_m * self.outwards
        back = [middle + np.sqrt(1.0 - s * s) * (front - middle) - s * BACK_M * out for s in LAYERS]
        return trimesh.convex.convex_hull(np.concatenate([front, *back]) @ self.turn.T)

    def model(self, cover_m: float) -> ObservationModel:
        """The part as the skin meets it."""
        mesh, layout = self.mesh(cover_m), self.layout()
        scene = scenes.build(mesh, layout, self.height_m - float(mesh.bounds[0][2]))
        return ObservationModel(scene, layout, SkinConfig().full_scale_depth_m)

    def depth_m(self, touches: Index) -> Floats:
        """(n, M) how deep taxels are inside the part's skin, in three dimensions."""
        mesh, arms = self.mesh(0.0), self.arms[touches]
        place = np.einsum("tij,mj->tmi", arms[:, :, :3], self.place) + arms[:, None, :, 3]
        level = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
        return np.array([(level - each @ mesh.face_normals.T).min(axis=1) for each in place])


class LearnedSkin(NamedTuple):
    """What half A tells of an arm's skin."""

    share: Floats  # (M,) share of presses that each taxel answers
    cover_m: float  # how far outside the part's taxels half of these answers come


def learned(recordings: Sequence[SkinRecording]) -> LearnedSkin:
    """The skin of the arm of all these recordings."""
    half_a = [np.flatnonzero(~each.is_b) for each in recordings]
    each_of = list(zip(recordings, half_a, strict=True))
    depth_m = np.concatenate([each.depth_m(at) for each, at in each_of])
    on = np.concatenate([each.on[at] for each, at in each_of])
    pressed = (depth_m > 0.0) & (depth_m < FAR_M)
    answered = (on & pressed).sum(axis=0)
    share = (answered + USUAL[0]) / (pressed.sum(axis=0) + sum(USUAL))
    near = np.abs(depth_m) < FAR_M
    d, told, most = depth_m[near], on[near], np.broadcast_to(share, on.shape)[near]

    def surprise(v: Floats) -> float:
        likely = np.clip(v[2] + most * expit((d - v[0]) / v[1]), 1e-6, 1.0 - 1e-6)
        return float(-np.where(told, np.log(likely), np.log1p(-likely)).mean())

    onset_m = minimize(surprise, (-0.003, 0.001, 0.01), method="Nelder-Mead").x[0]
    return LearnedSkin(share, max(-float(onset_m), 0.0))


class Arm:
    """An arm's recordings by the part, its skin, and the parts as that skin meets them."""

    def __init__(self, recordings: dict[str, SkinRecording]) -> None:
        self.recordings = recordings
        self.skin = learned([*recordings.values()])
        models = {part: one.model(self.skin.cover_m) for part, one in recordings.items()}
        self.known = {part: Known(model, Table(model)) for part, model in models.items()}
        answers = np.tile(np.clip(self.skin.share, *SHARES), BANDS)
        self.noise = Noise(SIGMA, 0.0, sag_m=SAG_M, sag_sd=SAG_SD, answers=answers)

    def activation(self, t: float, on: Bools, band: int) -> Activation:
        """A reading of the taxels (M,) that answer, at a height."""
        m = len(on)
        z, live = np.zeros((BANDS, m)), np.zeros((BANDS, m), bool)
        z[band], live[band] = READ * on, self.skin.share > LEAST_SHARE
        return Activation(t, z.ravel(), live.ravel(), noise=self.noise)


@lru_cache
def arms_of(folder: Path) -> dict[str, Arm]:
    """All that is recorded, by the names of arms. Raises SetupError."""
    found: dict[str, dict[str, SkinRecording]] = {}
    for path in sorted(folder.glob("*.npz")):
        arm, _, part = path.stem.rpartition("_")
        found.setdefault(arm, {})[part] = SkinRecording.read(path)
    parts = {part for of_arm in found.values() for part in of_arm}
    if not found or any(parts - of_arm.keys() for of_arm in found.values()):
        fault = "no recordings, or an arm has none of a part"
        raise SetupError(f"--data: {folder} has {fault}; make them by nao_recordings.py")
    return {name: Arm(parts) for name, parts in found.items()}


def play(arm: Arm, variant: Variant, seed: int) -> list[Touch]:
    """The estimate after each touch of a part; where half B has fewer poses the last one stands."""
    touched, known, tilt, prior, touches = variant
    recording, model, found = arm.recordings[touched], arm.known[touched].model, list[Touch]()
    truth, at = recording.drawn(tilt, seed)
    at = at[:touches]
    first, *more = (arm.known[part] for part in known)
    config = FilterConfig(seed=OWN_SEEDS + seed, noise_sigma=SIGMA, gain_cv=0.0)
    estimator = Estimator(first.model, first.proposal, config, ROBOT_M, more)
    if prior != "none":
        off = np.sqrt(np.diag(PRIOR)) * np.random.default_rng(seed).standard_normal(3)
        x, y, theta = (truth + off).tolist()
        estimator.take_prior(PosePrior(x=x, y=y, theta=theta, cov=PRIOR))
    sensors, bands = se2.compose(truth, recording.sensors[at]), recording.band[at]
    for k, (on, sensor, band) in enumerate(zip(recording.on[at], sensors, bands, strict=True)):
        for s in PRESSED_S + RELEASED_S:
            estimator.on_scan(arm.activation(k + s, on & (s in PRESSED_S), band), sensor)
        now = estimator.estimate
        is_right = estimator.known[now.object].model is model
        error_m = add_m(model.scene, now.map, truth)[1] if is_right else math.nan
        found.append(touch_of(now, now.p, 1e3 * error_m))
    return found + found[-1:] * (touches - len(found))


def trials(folder: str, arm: str, variant: Variant, seeds: Sequence[int]) -> list[Any]:
    """A job: of each seed the fields of each touch."""
    one = arms_of(Path(folder))[arm]
    return [[without_nan([*touch]) for touch in play(one, variant, seed)] for seed in seeds]


def run(
    question: Question, asked: Selection, work: Callable[[Sequence[Job]], dict[str, Any]]
) -> list[Played]:
    """The trials of the question: of each arm and part, tilt and variant.

    Raises:
        SetupError: recordings are not named, or cannot be used.
    """
    if asked.data is None:
        raise SetupError(f"{question.name}: needs --data DIR, recordings; see docs/real-skin.md")
    folder = asked.data.resolve()
    digest = hashlib.sha256(b"".join(f.read_bytes() for f in sorted(folder.glob("*.npz"))))
    key = code() + jobs.code(("taxeld_training/evaluation/real.py",)) + digest.hexdigest()[:16]
    seeds = asked.seeds or tuple(range(question.seeds))
    todo: list[tuple[Job, dict[str, str], tuple[str, ...], int]] = []
    each = product(sorted(arms_of(folder)), question.objects, question.tilts, VARIANTS)
    for arm, part, tilt, (knows, touched, prior) in each:
        others = tuple(name for name in question.objects if name != part)
        known = question.objects if knows == "both" else (part,) if touched == "known" else others
        variant: Variant = part, known, tilt, prior, question.touches
        name = f"{arm}_{part} {tilt:g} {knows} {touched} {prior}"
        labels = {"object": part, "tilt": f"{tilt:g} rad", "knows": knows, "touched": touched}
        labels |= {"prior": prior, "cell": arm}
        job = Job(name, trials, (str(folder), arm, variant, seeds), code=key)
        todo.append((job, labels, known, known.index(part) if part in known else -1))
    done = work([job for job, *_ in todo])
    return [
        Played(labels, known, true, seeds, touches_of(done[job.name]))
        for job, labels, known, true in todo
    ]
