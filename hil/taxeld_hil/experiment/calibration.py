"""`taxeld-hil calibration`: what a calibration finds and gains, and what is noticed without one.

A robot whose poses are off by a mount presses a box 20 times (`world.calibration_touches`). Runs of
the sort `find` calibrate so, with the object's pose once given and once not. `buy` calibrates
likewise and touches the box elsewhere, with the calibration and without it. All others count
touches until a fault of the calibration is noticed.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from taxeld.arrays import Floats, Poses
from taxeld.errors import SetupError
from taxeld.model import se2
from taxeld.pipeline.calibration_check import Suspect
from taxeld.skin.calibration import Calibration
from taxeld_hil.calibration.calibrate import Result, fitted
from taxeld_hil.calibration.observer import Observer
from taxeld_hil.experiment.measurement import RunRow, digest, require
from taxeld_hil.jobs import Job
from taxeld_hil.rig.rig import IDLE_S, Rig
from taxeld_hil.run.fake_run import FakeRun
from taxeld_hil.scenario import scenario as scenarios
from taxeld_hil.scenario.scenario import Scenario
from taxeld_hil.world import calibration_touches
from taxeld_hil.world import touches as paths

RATE_HZ = 40.0
AFTER = (3, 6, 10)  # touches after which errors are noted
SEEN_S = 0.4  # after the end of a touch, by when the daemon has checked it
NO_FILTER = 'proposal = "manifold"\nparticles = 50\nparticles_max = 50\ninjected = 10'
MOUNT_MOST = np.array([0.003, 0.003, np.radians(3.0)])  # largest mounts that are drawn: m, m, rad
TOUCHES, SOON = 12, 8  # until a doubt must have been raised; an early doubt
RIGHT = 3  # times as many seeds where nothing is wrong
FAULTS: dict[str, dict[str, Any]] = {
    "none": {},
    "full scale ×2.5": {"factor": 2.5},
    "full scale ÷2.5": {"factor": 0.4},
    "mount 3 mm": {"mount": np.array([0.003, 0.0, 0.0])},
    "mount 3°": {"mount": np.array([0.0, 0.0, np.radians(3.0)])},
    "modules swapped": {"modules": (2, 3)},
}


def jobs(skins: Sequence[str], seeds: int) -> list[Job]:
    """A job for each run, seed by seed.

    Raises:
        SetupError: there is no such skin, it is no soft one, there is no mesh here, or there are no
            seeds.
    """
    require(("box", "mug"), skins, seeds, soft=True)
    found = []
    for seed in range(RIGHT * seeds):
        for skin in skins:
            for sort in ("find", "buy", *FAULTS):
                for name in ("box", "mug") if sort == "none" else ("box",):
                    if seed < seeds or sort == "none":
                        subject = scenarios.load("demo").touching(name).on(skin)
                        title = f"{sort}, {name}, {skin}, seed {seed}"
                        arguments = (sort, subject, skin, seed)
                        found.append(Job(title, play, arguments, code=digest(subject)))
    return found


def play(sort: str, subject: Scenario, skin: str, seed: int) -> RunRow:
    """The figures of one run of a sort: find, buy or one of FAULTS."""
    run = {"sort": sort, "object": subject.bundle, "skin": skin, "seed": seed}
    if sort in FAULTS:
        touch, suspect = noticed(subject, seed, TOUCHES, **FAULTS[sort])
        return {**run, "noticed_after": touch, "suspect": suspect}
    mount = _mount(seed)
    if sort == "find":
        return {
            **run,
            "given": _found(subject, seed, mount, given=True),
            "found": _found(subject, seed, mount, given=False),
        }
    result, _ = calibrated(subject, seed, mount)
    return {
        **run,
        "without": errors_mm(subject, seed, np.zeros(3), None),
        "without, mount off": errors_mm(subject, seed, mount, None),
        "with": errors_mm(subject, seed, mount, result.calibration),
    }


def pictured(skin: str) -> Result:
    """A calibration by a box, for a picture."""
    return calibrated(scenarios.load("demo").touching("box").on(skin), 0, _mount(0))[0]


def described(run: RunRow) -> str:
    """A run's figures in short."""
    names = {"sort", "object", "skin", "seed"}
    return ", ".join(f"{name} {value}" for name, value in run.items() if name not in names)


def lines(runs: Sequence[RunRow]) -> Iterator[str]:
    """The runs in few numbers, as Markdown tables."""
    groups: dict[tuple[str, str, str], list[RunRow]] = {}
    for row in runs:
        groups.setdefault((row["sort"], row["skin"], row["object"]), []).append(row)
    yield "| skin, pose | runs, refused | gains known | off: gains, median (most) | mount | yaw |"
    yield "|---|---|---|---|---|---|"
    for (sort, skin, _), group in groups.items():
        for kind in ("given", "found") if sort == "find" else ():
            yield f"| {skin}, {kind} | {_accuracy([row[kind] for row in group])} |"
    yield ""
    after = ", ".join(map(str, AFTER))
    yield f"| skin | median error after {after} touches | without | with the mount off | with |"
    yield "|---|---|---|---|---|"
    for (sort, skin, _), group in groups.items():
        if sort == "buy":
            kinds = ("without", "without, mount off", "with")
            medians = [np.median([row[kind] for row in group], axis=0) for kind in kinds]
            cells = [", ".join(f"{mm:.2f}" for mm in each) + " mm" for each in medians]
            yield f"| {skin}, {len(group)} seeds | {' | '.join(cells)} |"
    yield ""
    yield f"| what is wrong | skin, object | runs | doubts | within {SOON} touches | about |"
    yield "|---|---|---|---|---|---|"
    for (sort, skin, name), group in groups.items():
        if sort in FAULTS:
            touch = np.array([row["noticed_after"] for row in group])
            found = [row["suspect"] for row in group if row["suspect"]]
            about = ", ".join(f"{found.count(each)} {each}" for each in sorted(set(found)))
            soon = np.count_nonzero((touch > 0) & (touch <= SOON))
            raised = np.count_nonzero(touch)
            yield f"| {sort} | {skin}, {name} | {len(group)} | {raised} | {soon} | {about} |"


def _accuracy(found: Sequence[RunRow]) -> str:
    good = [each for each in found if "refused" not in each]
    head = f"{len(found)}, {len(found) - len(good)}"
    if not good:
        return f"{head} | | | |"
    known, gain, mount, yaw = (
        (np.median(values), np.max(values))
        for values in (
            [each[key] for each in good if each[key] is not None]
            for key in ("gains_known", "gain_off", "mount_off_mm", "yaw_off_deg")
        )
    )
    return (
        f"{head} | {known[0]:.0f} | {gain[0]:.1%} ({gain[1]:.1%}) "
        f"| {mount[0]:.2f} ({mount[1]:.2f}) mm | {yaw[0]:.2f} ({yaw[1]:.2f})°"
    )


def _found(at: Scenario, seed: int, mount: Poses, *, given: bool) -> RunRow:
    try:
        result, full_scale = calibrated(at, seed, mount, given=given)
    except SetupError as error:
        return {"refused": str(error)}
    c, known = result.calibration, result.known
    off = np.abs(c.full_scale_counts * c.gain / full_scale - 1.0)
    mount_off = np.abs(c.mount - mount)
    return {
        "gains_known": int(known.sum()),
        "gain_off": round(float(np.median(off[known])), 4) if known.any() else None,
        "gains_within_2_sd": round(float(np.mean(off < 2.0 * c.gain_sd)), 4),
        "mount_off_mm": round(1e3 * float(np.hypot(*mount_off[:2])), 4),
        "yaw_off_deg": round(float(np.degrees(mount_off[2])), 4),
        "left": round(result.fit.left, 4),
    }


def _mount(seed: int) -> Poses:
    """(3,)"""
    return np.random.default_rng([seed, 3]).uniform(-MOUNT_MOST, MOUNT_MOST)


def mounted(rig: Rig, mount: Poses) -> None:
    """Have the robot state the pose of a frame in which the sensor's is `mount` (3,)."""
    true, back = rig.poses, se2.inverse(mount)

    def poses(t: float, now: float, wall: float) -> list[tuple[float, float, float, float]]:
        rows = true(t, now, wall)
        frames = [se2.compose(np.array(row[1:]), back).tolist() for row in rows]
        return [(row[0], x, y, yaw) for row, (x, y, yaw) in zip(rows, frames, strict=True)]

    rig.poses = poses  # type: ignore[method-assign]


def swapped(rig: Rig, one: int, other: int) -> None:
    """Have two modules, of as many channels, sit in each other's place."""
    channels = rig.world.channels
    at, there = (np.flatnonzero(channels.module == module) for module in (one, other))
    taxel = channels.taxel.copy()
    taxel[at], taxel[there] = channels.taxel[there], channels.taxel[at]
    channels.taxel = taxel


def calibrated(
    scenario: Scenario, seed: int, mount: Poses, *, given: bool = True
) -> tuple[Result, Floats]:
    """The result of pressing the scenario's object with its skin, and the counts (M,) that its
    taxels truly read at full depth. `mount` (3,) is as in `mounted`.

    Raises:
        SetupError: the presses do not suffice.
    """
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, filter_keys=NO_FILTER if given else "")
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    rig.path = calibration_touches.plan(rig.model, rig.world.truth, seed).path
    mounted(rig, mount)
    observer = Observer(daemon.pipeline)
    for k in range(round(rig.duration_s * RATE_HZ)):
        run.step(k / RATE_HZ)
        for outcome in daemon.outcomes:
            observer.on_outcome(outcome)
    placed = rig.world.truth if given else None
    full_scale: Floats = rig.world.physics.full_scale  # type: ignore[attr-defined]  # a soft skin
    return fitted(observer.observed(), run.config, placed), full_scale


def errors_mm(
    scenario: Scenario, seed: int, mount: Poses, calibration: Calibration | None
) -> list[float]:
    """Errors [mm] after so many touches of AFTER, the object elsewhere than it was calibrated.
    `mount` (3,) is as in `mounted`."""
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, calibration=calibration)
    place = np.array([scenario.place_m, scenario.place_m, np.pi])
    run.rig.world.truth = np.random.default_rng([seed, 7]).uniform(-place, place)
    run.judge = run.judging()
    plan = paths.plan(run.rig.model, run.rig.world.truth, seed + 1000, max(AFTER))
    run.rig.path = plan.path
    mounted(run.rig, mount)
    found: list[float] = []
    k = 0
    begins_s = [*(touch.begin_s for touch in plan.touches), plan.path.duration_s]
    for note_s in (IDLE_S + begins_s[n] for n in AFTER):
        while k / RATE_HZ < note_s:
            run.step(k / RATE_HZ)
            k += 1
        last = run.judge.last
        assert last is not None  # noqa: S101  (a run has many estimates)
        found.append(round(run.judge.error_mm(last.map), 3))
    return found


def noticed(
    scenario: Scenario,
    seed: int,
    touches: int,
    *,
    factor: float = 1.0,
    mount: Poses = se2.IDENTITY,
    modules: tuple[int, int] | None = None,
) -> tuple[int, str]:
    """After which touch a doubt is raised, and what about; 0 and nothing where none is. `factor`:
    of the full scale that the daemon has, to the skin's own; `mount` (3,) is as in `mounted`."""
    assumed = uniform(scenario, len(Rig(scenario, seed).model.layout), factor)
    run = FakeRun(scenario, seed, rate_hz=RATE_HZ, calibration=assumed)
    rig, daemon = run.rig, run.daemon
    assert daemon is not None  # noqa: S101  (no fault kills it)
    mounted(rig, mount)
    if modules is not None:
        swapped(rig, *modules)
    plan = paths.plan(rig.model, rig.world.truth, seed, touches)
    rig.path = plan.path
    ends = [IDLE_S + touch.end_s + SEEN_S for touch in plan.touches]
    for k in range(round(ends[-1] * RATE_HZ) + 1):
        run.step(k / RATE_HZ)
        suspect = daemon.pipeline.doubt.suspect
        if suspect is not Suspect.NONE:
            return int(np.searchsorted(ends, k / RATE_HZ)) + 1, suspect.name.lower()
    return 0, ""


def uniform(scenario: Scenario, taxels: int, factor: float) -> Calibration:
    """A calibration in which all taxels are alike, and the full scale is wrong by a factor."""
    ones, zeros = np.ones(taxels), np.zeros(taxels)
    return Calibration(
        t=0.0,
        digest="",
        object=scenario.bundle,
        presses=0,
        full_scale_depth_m=0.005,
        full_scale_counts=factor * scenario.full_scale_counts,
        full_scale_sd=0.0,
        bend=0.0,
        bend_sd=0.0,
        mount=np.zeros(3),
        mount_sd=np.zeros(3),
        noise_sigma=0.04,
        gain_cv=0.17,
        gain=ones,
        gain_sd=zeros,
        onset=zeros,
        onset_sd=zeros,
        noise_counts=scenario.skin.noise_counts[0] * ones,
        frozen=zeros > 0.0,
    )
