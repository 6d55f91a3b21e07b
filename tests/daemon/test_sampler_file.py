"""Graphs that are not what the exporter writes: refused before a touch meets them."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals.sampler import Sampler

SKIN = layouts.load("cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015")
TAXELS = len(SKIN)
Shape = list[int | str]


def graph(
    noise: Shape = [1, "samples", 4],  # noqa: B006
    z: Shape = [1, TAXELS],  # noqa: B006
    kind: int = TensorProto.FLOAT,
    operator: str = "Add",
    weight: TensorProto | None = None,
    names: tuple[str, str, str] = ("z", "live", "noise"),
    sparse: bool = False,
) -> bytes:
    """Poses that are the noise and a weight, by default a fine sampler."""
    weight = weight or helper.make_tensor("w", kind, [1], [0.5])
    inputs = [
        helper.make_tensor_value_info(name, kind, shape)
        for name, shape in zip(names, (z, [1, TAXELS], noise), strict=True)
    ]
    made = helper.make_graph(
        [
            helper.make_node("ReduceMean", [names[2]], ["flat"], axes=[0], keepdims=0),
            helper.make_node(operator, ["flat", "w"], ["poses"]),
        ],
        "sampler",
        inputs,
        [helper.make_tensor_value_info("poses", kind, None)],
        [] if sparse else [weight],
    )
    if sparse:
        values = onnx.SparseTensorProto(values=weight, dims=[1])
        values.indices.CopyFrom(helper.make_tensor("i", TensorProto.INT64, [1], [0]))
        made.sparse_initializer.append(values)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return bytes(model.SerializeToString())


def elsewhere(location: str) -> TensorProto:
    """A weight that lies in another file."""
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1])
    weight.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "4")):
        weight.external_data.add(key=key, value=value)
    return weight


def sampler(content: bytes) -> Sampler:
    return Sampler(content, SKIN, "density", Path("bundle/own.onnx"))


def test_a_sampler_gives_poses() -> None:
    poses = sampler(graph()).propose(
        np.eye(1, TAXELS)[0], np.ones(TAXELS, bool), 30, np.random.default_rng(0)
    )
    assert poses.shape == (30, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "unusable"),
        (b"junk", "unusable"),
        (graph()[:200], "unusable"),
        (graph(z=[1, TAXELS + 1]), f"is not for a skin of {TAXELS} taxels"),
        (graph(noise=[1, 8, 4]), "noise is not"),
        (graph(noise=[1, "samples", 5]), "noise is not"),
        (graph(noise=["steps", "samples", 4]), "noise is not"),
        (graph(noise=[10**9, "samples", 4]), "noise is not"),
        (graph(names=("z", "live", "seed")), "inputs are not"),
        (graph(kind=TensorProto.DOUBLE), "unusable"),
        (graph(operator="MatMul"), "unusable"),
        (graph(operator="Nonsense"), "unusable"),
        (graph(weight=helper.make_tensor("w", 1, [1], [np.nan])), "no finite poses"),
        (graph(weight=helper.make_tensor("w", 1, [3, 1, 1], [0.0] * 3)), "unusable"),
    ],
)
def test_a_graph_that_is_no_sampler_is_one_line(content: bytes, said: str) -> None:
    with pytest.raises(SetupError) as refused:
        sampler(content)
    assert said in str(refused.value)
    assert str(refused.value).startswith("bundle/own.onnx: ")
    assert str(refused.value).isprintable()


@pytest.fixture
def secret(tmp_path: Path) -> Iterator[Path]:
    """A file of numbers beside the current directory, and one in it."""
    inside, before = tmp_path / "inside", Path.cwd()
    inside.mkdir()
    for path in (tmp_path / "secret.bin", inside / "own.bin"):
        np.full(1, 0.25, dtype=np.float32).tofile(path)
    os.chdir(inside)
    yield tmp_path / "secret.bin"
    os.chdir(before)


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
@pytest.mark.parametrize("place", ["../secret.bin", "own.bin", "absolute"])
def test_no_graph_reads_another_file(secret: Path, place: str, sparse: bool) -> None:
    weight = elsewhere(str(secret) if place == "absolute" else place)
    with pytest.raises(SetupError, match="names other files as its weights"):
        sampler(graph(weight=weight, sparse=sparse))


def test_a_graph_of_onnxruntimes_own_format_is_refused(tmp_path: Path) -> None:
    options = ort.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "own.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    ort.InferenceSession(graph(), options, providers=["CPUExecutionProvider"])
    with pytest.raises(SetupError, match="unusable"):
        sampler((tmp_path / "own.ort").read_bytes())
