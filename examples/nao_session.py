"""Makes a session of recorded touches, as of an array of binary readings, with its calibration.

    python nao_session.py recordings left_arm_head b session
    taxeld replay session

It has touches of half b (or a) of the robot's poses; what is known of the skin, as the share of
presses that each taxel answers, is learned on the other half. The layout has the arm at each height
at which it touches the part: in a scan, which has one height, all others are not valid.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld.service import calibration_file
from taxeld.skin.calibration import Calibration, skin_digest
from taxeld.source.recorder import Recorder
from taxeld.source.session import Pass, SensorPose
from taxeld_hil.run.session_run import write_truth
from taxeld_protocol.array import FULL, REST, ArrayFrame
from taxeld_sim.objects import bundles
from taxeld_training.evaluation import real
from taxeld_training.evaluation.real import PRESSED_S, RELEASED_S, Arm

BEGUN_S, TOUCHES, TOUCH_S = 1.7e9, 12, 2.0
CONFIG = """\
[source]
kind = "array"
endpoint = "tcp://127.0.0.1:9870"
[sensor_pose]
endpoint = "tcp://127.0.0.1:9874"
sigma_m = 0.004
[skin]
layout = "arm.csv"
calibration = "arm.toml"
[scene]
bundle = "part"
"""


def write(arm: Arm, part: str, out: Path, tilt: float = 0.2, seed: int = 0) -> None:
    """Write the touches of a trial, and what half A tells of the arm's skin."""
    recording, model = arm.recordings[part], arm.known[part].model
    (out / "part").mkdir(parents=True)
    table = np.column_stack([model.layout.uid, model.layout.position_m, model.layout.normal])
    np.savetxt(out / "arm.csv", table, "%.7g", ",", header="uid,x,y,z,nx,ny,nz", comments="")
    layout, mesh = layouts.load(str(out / "arm.csv")), recording.mesh(arm.skin.cover_m)
    own = np.linalg.inv(layout.frame)  # the layout's frame in the arm's, about the same axis
    height_m = recording.height_m + own[2, 3] - float(mesh.bounds[0][2])
    mesh.export(out / "part.stl")
    bundles.write(str(out / "part.stl"), [(layout, height_m)], model.depth_max_m, out / "part")
    truth, at = recording.drawn(tilt, seed)
    with Recorder(out, moves=True) as recorder:
        for k, touch in enumerate(at[:TOUCHES]):
            pose = se2.compose(truth, recording.sensors[touch]).tolist()
            for s in PRESSED_S + RELEASED_S:
                on, t = recording.on[touch] & (s in PRESSED_S), BEGUN_S + TOUCH_S * k + s
                counts = np.zeros((real.BANDS, len(on)), int)  # 0: not valid
                counts[recording.band[touch]] = REST + real.READ * FULL * on
                recorder.take(SensorPose(t, *pose))
                recorder.take(ArrayFrame(t, "arm", REST, tuple(counts.ravel().tolist())))
                recorder.take(Pass(t))
    write_truth(out, truth)
    share = np.tile(arm.skin.share, real.BANDS)
    even = dict.fromkeys(("full_scale_sd", "bend", "bend_sd", "gain_cv"), 0.0)
    even |= dict.fromkeys(("gain_sd", "onset", "onset_sd", "noise_counts"), 0.0 * share)
    known = Calibration(
        **even,
        t=time.time(),
        digest=skin_digest(layout),
        object=part,
        presses=int(sum((~each.is_b).sum() for each in arm.recordings.values())),
        full_scale_depth_m=model.depth_max_m,
        full_scale_counts=FULL,
        mount=np.array([own[0, 3], own[1, 3], np.arctan2(own[1, 0], own[0, 0])]),
        mount_sd=np.full(3, real.ROBOT_M),
        noise_sigma=real.SIGMA,
        gain=np.ones(len(share)),
        frozen=share < real.LEAST_SHARE,
        answers=share,
    )
    (out / "arm.toml").write_text(calibration_file.dump(known, layout), encoding="utf-8")
    (out / "config.toml").write_text(CONFIG)


def main(folder: Path, name: str, half: str, session: Path) -> None:
    """`name`: of a file of `folder`. Raises SetupError, or OSError where the session is there."""
    if half not in ("a", "b"):
        raise SetupError(f"the half must be a or b, not {half}")
    real.SkinRecording.read(folder / f"{name}.npz")
    arm, _, part = name.rpartition("_")
    found = real.arms_of(folder)[arm].recordings
    halves = {one: replace(each, is_b=each.is_b == (half == "b")) for one, each in found.items()}
    write(Arm(halves), part, session)


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]), *sys.argv[2:4], Path(sys.argv[4]))
    except (IndexError, SetupError, OSError) as error:
        sys.exit(__doc__ if len(sys.argv) < 5 else str(error))
