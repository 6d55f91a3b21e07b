"""The inverse observation model at run time: an ONNX graph from touch and noise to poses."""

import os
from pathlib import Path
from typing import Any, Self

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.proposals import seal

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # its wheels report home by default
import onnxruntime as ort

TRIED = 8  # samples of the trial call
MOST_STEPS = 10_000  # of noise


class Sampler:
    """Samples of p(pose | activations) by a trained graph.

    The graph takes the touch as the skin has it, and turns it for itself. Its noise is an input, so
    that a seed replays it.
    """

    def __init__(self, graph: bytes, layout: Layout, name: str, path: Path) -> None:
        """`graph`: the content of the ONNX file that `path` names in messages.

        Raises:
            SetupError: it is damaged, or no sampler for this skin.
        """
        self.name = name
        taxels = len(layout)
        try:
            self._session = _session(graph)
            self._noise_steps = _noise_steps(self._session, taxels)
            self._try(taxels)
        except Exception as error:  # onnxruntime's own exceptions share no public base
            raise SetupError(
                f"{path}: unusable sampler ({seal.reason(error)}); build the bundle again"
            ) from None

    @classmethod
    def read(cls, path: Path, layout: Layout, name: str) -> Self:
        """A sampler from a file of its own, outside a bundle."""
        return cls(seal.read(path), layout, name, path)

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

    def _try(self, taxels: int) -> None:
        """Raises ValueError unless a touch gets poses."""
        touch = np.eye(1, taxels)[0]
        poses = self.propose(touch, np.ones(taxels, bool), TRIED, np.random.default_rng(0))
        if poses.shape != (TRIED, 3) or not np.isfinite(poses).all():
            raise ValueError("a touch gets no finite poses")


def _session(graph: bytes) -> Any:
    """One thread, no spinning: the loop's core is not to be fought over.

    A graph may name other files as its weights, any file of this machine up to onnxruntime 1.24;
    it names them by this key, so that a graph without the word reads none.
    """
    if b"location" in graph:
        raise ValueError("it names other files as its weights")
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # else it is guessed
    options.log_severity_level = 4  # what goes wrong is raised, and said once
    return ort.InferenceSession(
        graph, options, providers=["CPUExecutionProvider"], enable_fallback=0
    )  # which would print what went wrong, and try once more


def _noise_steps(session: Any, taxels: int) -> int:
    """The steps of a graph (z, live, noise) → poses; raises ValueError where it is none such."""
    inputs = {i.name: i.shape for i in session.get_inputs()}
    if inputs.keys() != {"z", "live", "noise"}:
        raise ValueError("its inputs are not z, live and noise")
    if inputs["z"] != [1, taxels] or inputs["live"] != [1, taxels]:
        raise ValueError(f"it is not for a skin of {taxels} taxels")
    match inputs["noise"]:
        case [int(steps), samples, 4] if 0 < steps <= MOST_STEPS and not isinstance(samples, int):
            return steps
    raise ValueError("its noise is not (steps, any number of samples, 4)")
