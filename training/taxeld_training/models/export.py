"""A sampler as one ONNX file: opset, shapes, normalisation and training config inside it."""

import copy
import json
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch

from taxeld_training.models.density import ContactDensity
from taxeld_training.models.diffusion import DiffusionSampler

AnySampler = DiffusionSampler | ContactDensity

OPSET = 20
HALVED_FROM = 256  # least number of values of a tensor that is worth halving
TRACED, TRIED = 100, 64  # samples; the graph takes any number, so it is checked with another
# Largest difference to torch of 99 % of the pose values, in their own units. A sample at a kink of
# the contact curve may fall on its other side by rounding.
TOLERANCE = 1e-3


def export(sampler: AnySampler, taxels: int, path: Path, metadata: Mapping[str, object]) -> float:
    """Write `sampler` to `path`; → its difference to torch on fixed inputs (99 % quantile).

    The graph is traced by TorchScript: torch's newer exporter takes 30 times as long for the
    hundred steps of a DDPM, and the graph it makes is no faster.

    Raises:
        RuntimeError: the graph differs from torch.
    """
    generator = torch.Generator().manual_seed(0)
    z = (torch.rand(1, taxels, generator=generator) - 0.8).clamp(
        min=0.0
    ) * 5.0  # a fifth of the taxels is pressed
    live = torch.ones(1, taxels)
    noise = torch.randn(sampler.steps, TRACED, 4, generator=generator)
    sampler = rounded(sampler)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # torch warns that this exporter is old
        torch.onnx.export(
            sampler,
            (z, live, noise),
            path,
            dynamo=False,
            opset_version=OPSET,
            input_names=["z", "live", "noise"],
            output_names=["poses"],
            dynamic_axes={"noise": {1: "samples"}, "poses": {0: "samples"}},
        )
        noise = noise[:, :TRIED]
        expected = sampler(z, live, noise).numpy()
    model = onnx.load(path)
    for node in model.graph.node:
        node.ClearField("doc_string")
        node.ClearField("name")
    model.graph.ClearField("value_info")
    _shorten(model.graph)
    for key, value in metadata.items():
        entry = model.metadata_props.add()
        entry.key, entry.value = key, json.dumps(value)
    _halve(model.graph)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    inputs = {"z": z.numpy(), "live": live.numpy(), "noise": noise.numpy()}
    gap = float(np.quantile(np.abs(session.run(None, inputs)[0] - expected), 0.99))
    if not gap < TOLERANCE:
        raise RuntimeError(f"{path}: the exported graph differs from torch by {gap:g}")
    return gap


def rounded(sampler: AnySampler) -> AnySampler:
    """The sampler with those weights that `_halve` halves rounded to float16."""
    copied = copy.deepcopy(sampler).eval()
    for values in [*copied.parameters(), *copied.buffers()]:
        if values.dtype == torch.float32 and values.numel() >= HALVED_FROM:
            values.data = values.data.half().float()
    return copied


def _shorten(graph: onnx.GraphProto) -> None:
    """Number the values between inputs and outputs: their names would take a quarter of a DDPM."""
    kept = {value.name for value in (*graph.input, *graph.output)} | {""}
    numbered: dict[str, str] = {}

    def short(name: str) -> str:
        return name if name in kept else numbered.setdefault(name, f"{len(numbered):x}")

    for tensor in graph.initializer:
        tensor.name = short(tensor.name)
    for node in graph.node:
        node.input[:], node.output[:] = map(short, node.input), map(short, node.output)


def _halve(graph: onnx.GraphProto) -> None:
    """Store large weights as float16, cast back when the file is loaded: half the file, the same
    arithmetic."""
    casts = []
    for tensor in graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < HALVED_FROM:
            continue
        name = tensor.name
        tensor.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(
            onnx.helper.make_node("Cast", [tensor.name], [name], to=onnx.TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
