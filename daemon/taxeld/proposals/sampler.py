"""The inverse observation model at run time: an ONNX graph from touch and noise to poses."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.proposals import graph_file, seal

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # its wheels report home by default
import onnxruntime as ort

TRIED = 8  # samples of the trial call


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
        with _told_of(path):
            self._noise_steps = graph_file.noise_steps(graph, layout)
            self._session = _session(graph)
            self._try(len(layout))

    @staticmethod
    def check(graph: bytes, layout: Layout, path: Path) -> None:
        """As far as can be told without opening it.

        Raises:
            SetupError: it is no sampler for this skin.
        """
        with _told_of(path):
            graph_file.noise_steps(graph, layout)

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


@contextlib.contextmanager
def _told_of(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # onnxruntime's own exceptions share no public base
        raise SetupError(
            f"{path}: unusable sampler ({seal.reason(error)}); build the bundle again"
        ) from None


def _session(graph: bytes) -> Any:
    """One thread, no spinning: the loop's core is not to be fought over."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # else it is guessed
    options.log_severity_level = 4  # what goes wrong is raised, and said once
    return ort.InferenceSession(
        graph, options, providers=["CPUExecutionProvider"], enable_fallback=0
    )  # which would print what went wrong, and try once more
