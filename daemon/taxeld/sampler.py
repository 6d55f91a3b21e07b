"""The inverse observation model at run time: an ONNX graph from touch and noise to poses."""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from taxeld.errors import SetupError
from taxeld.layout import Layout
from taxeld.se2 import Poses

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


class Sampler:
    """Samples of p(pose | activations) by a trained graph.

    The graph takes the touch as the skin has it, and turns it for itself. Its noise is an input, so
    that a seed replays it.
    """

    def __init__(self, path: Path, layout: Layout, name: str) -> None:
        self.name = name
        self.file = path.name
        self._session = _session(path)
        shapes = {i.name: i.shape for i in self._session.get_inputs()}
        taxels = len(layout)
        if shapes.get("z") != [1, taxels] or shapes.get("live") != [1, taxels]:
            raise SetupError(f"{path}: is no sampler for a skin of {taxels} taxels")
        noise = shapes.get("noise")
        if noise is None or len(noise) != 3 or not isinstance(noise[0], int) or noise[2] != 4:
            raise SetupError(f"{path}: has no noise input (steps, samples, 4)")
        self._noise_steps = noise[0]
        self.propose(np.eye(1, taxels)[0], np.ones(taxels, bool), 8, np.random.default_rng(0))

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        x, y, c, s = self._session.run(
            None,
            {
                "z": z[None].astype(np.float32),
                "live": live[None].astype(np.float32),
                "noise": rng.standard_normal((self._noise_steps, n, 4), dtype=np.float32),
            },
        )[0].T.astype(np.float64)
        return np.column_stack([x, y, np.arctan2(s, c)])


def _session(path: Path) -> Any:
    """One thread, no spinning: the loop's core is not to be fought over."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # what goes wrong is raised, and said once
    try:
        return ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions share no public base
        reason = str(error).splitlines()[0]
        raise SetupError(f"{path}: unreadable sampler ({reason}); build it again") from None
