"""The inverse observation model at run time: an ONNX graph from touch and noise to poses."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from taxeld.arrays import Bools, Floats, Poses
from taxeld.errors import SetupError
from taxeld.layout.layout import Layout
from taxeld.proposals import manifest

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # the wheels send telemetry
import onnxruntime as ort

TRIED = 8  # samples of the trial call
# nodes' types in a graph's bytes: field 4, its length, the name
ENDLESS = b"\x22\x04Loop", b"\x22\x04Scan", b"\x22\x02If"
MOST_STEPS = 10_000  # limit on the steps of noise
MOST_BYTES = 128_000_000  # of all samplers; a shipped one takes 32 MB for 10 000 samples

ort.create_and_register_allocator(
    ort.OrtMemoryInfo("Cpu", ort.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, ort.OrtMemType.DEFAULT),
    ort.OrtArenaCfg(MOST_BYTES, -1, -1, -1),
)


class Sampler:
    """Samples of p(pose | activations) by a trained graph.

    The graph gets activations in the layout's order and turns them itself. Its noise is an input,
    so that a seed repeats it.
    """

    def __init__(self, graph: bytes, layout: Layout, name: str, path: Path) -> None:
        """`graph`: the content of the ONNX file that messages name by `path`.

        Raises:
            SetupError: it is damaged, or no sampler for this skin.
        """
        self.name = name
        try:
            # this key names weights in other files, which a bundle does not vouch for
            if b"location" in graph:
                raise ValueError("it names other files as its weights")
            if any(op in graph for op in ENDLESS):
                raise ValueError("it has loops or branches, which need not end")
            self._session = _session(graph)
            self._noise_steps = _noise_steps(self._session, layout)
            touch, live = np.eye(1, len(layout))[0], np.ones(len(layout), bool)
            poses = self.propose(touch, live, TRIED, np.random.default_rng(0))
            if poses.shape != (TRIED, 3) or not np.isfinite(poses).all():
                raise ValueError("a touch gets no finite poses")
        except Exception as error:  # onnxruntime's own exceptions share no public base
            reason = manifest.reason(error)
            raise SetupError(f"{path}: unusable sampler ({reason}); {manifest.AGAIN}") from None

    def propose(self, z: Floats, live: Bools, n: int, rng: np.random.Generator) -> Poses:
        """z (M,), live (M,) → poses (n, 3)."""
        x, y, c, s = self._session.run(
            None,
            {
                "z": z[None].astype(np.float32),
                "live": live[None].astype(np.float32),
                "noise": rng.standard_normal((self._noise_steps, n, 4), dtype=np.float32),
            },
        )[0].T.astype(np.float64)
        return np.column_stack([x, y, np.arctan2(s, c)])


def _noise_steps(session: Any, layout: Layout) -> int:
    """The steps of noise of a graph (z, live, noise) → poses for this skin.

    Raises:
        ValueError: it is not such a graph; the message says why.
    """
    theirs = json.loads(session.get_modelmeta().custom_metadata_map.get("layout", "null"))
    if theirs not in (None, layout.digest):
        raise ValueError(f"it is for the layout {theirs}, not for {layout.name} ({layout.digest})")
    shapes = {given.name: given.shape for given in session.get_inputs()}
    if shapes.keys() != {"z", "live", "noise"}:
        raise ValueError("its inputs are not z, live and noise")
    if not shapes["z"] == shapes["live"] == [1, len(layout)]:
        raise ValueError(f"it is not for a skin of {len(layout)} taxels")
    match shapes["noise"]:
        case [int(steps), str() | None, 4] if 0 < steps <= MOST_STEPS:
            return steps
    raise ValueError("its noise is not (steps, any number of samples, 4)")


def _session(graph: bytes) -> Any:
    """A session of one thread without spinning, which would compete for the loop's core."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.load_model_format", "ONNX")  # avoids a guess
    options.add_session_config_entry("session.use_env_allocators", "1")  # the one with MOST_BYTES
    options.log_severity_level = 4  # faults are raised and reported once
    return ort.InferenceSession(
        graph,
        options,
        providers=["CPUExecutionProvider"],
        # a fault would otherwise be printed, and the call repeated
        enable_fallback=0,
        disabled_optimizers=["ConstantFolding"],  # it takes memory, and changes the last digits
    )
