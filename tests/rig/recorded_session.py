"""Writes recorded touches of a real skin as a session with its bundle, as an array's.

    python -m tests.rig.recorded_session recordings left_arm head session
    taxeld replay session

The layout has the arm at each height at which it touches; a scan has values at one of them.
"""

import json
import sys
from pathlib import Path

import numpy as np

from taxeld.layout import read as layouts
from taxeld.model import se2
from taxeld_hil.objects import bundles
from taxeld_training.trials import real
from taxeld_training.trials.real import PRESSED_S, RELEASED_S, Arm

BEGUN_S, TOUCHES, TOUCH_S = 1.7e9, 12, 2.0
WHERE = "tcp://127.0.0.1:9870", "tcp://127.0.0.1:9874"  # for a live sender and robot


def write(arm: Arm, part: str, out: Path, tilt: float = 0.2, seed: int = 0) -> None:
    """Write the touches of a trial."""
    recording, model = arm.recordings[part], arm.known[part].model
    (out / "part").mkdir(parents=True)
    table = np.column_stack([model.layout.uid, model.layout.position_m, model.layout.normal])
    np.savetxt(out / "arm.csv", table, "%.7g", ",", header="uid,x,y,z,nx,ny,nz", comments="")
    layout, mesh = layouts.load(str(out / "arm.csv")), recording.mesh(arm.skin.cover_m)
    own = np.linalg.inv(layout.frame)  # the layout's frame in the arm's, about the same axis
    height_m = recording.height_m + own[2, 3] - float(mesh.bounds[0][2])
    mesh.export(out / "part.stl")
    bundles.write(str(out / "part.stl"), [(layout, height_m)], model.depth_max_m, out / "part")
    mount = np.array([own[0, 3], own[1, 3], np.arctan2(own[1, 0], own[0, 0])])
    truth, at = recording.drawn(tilt, seed)
    poses, scans = [], []
    for k, touch in enumerate(at[:TOUCHES]):
        sensor = se2.compose(se2.compose(truth, recording.sensors[touch]), mount)
        for s in PRESSED_S + RELEASED_S:
            t = BEGUN_S + TOUCH_S * k + s
            felt = arm.activation(t, recording.on[touch] & (s in PRESSED_S), recording.band[touch])
            z = [v if live else None for v, live in zip(felt.z.tolist(), felt.live, strict=True)]
            poses.append([t, *sensor])
            scans.append(json.dumps({"t": t, "id": "arm", "z": z}) + "\n")
    (out / "array.jsonl").write_text("".join(scans))
    for name, rows in (("sensor_pose", poses), ("truth", [[BEGUN_S, *truth]])):
        np.savetxt(out / f"{name}.csv", rows, "%.6f", ",", header="t,x,y,theta", comments="")
    source = f'[source]\nkind = "array"\nendpoint = "{WHERE[0]}"\n'
    pose = f'[sensor_pose]\nendpoint = "{WHERE[1]}"\nsigma_m = {real.ROBOT_M}\n'
    more = '[skin]\nlayout = "arm.csv"\n[scene]\nbundle = "part"\n'
    (out / "config.toml").write_text(source + pose + more)


if __name__ == "__main__":
    folder, name, touched, session = sys.argv[1:]
    write(real.arms_of(Path(folder))[name], touched, Path(session))
