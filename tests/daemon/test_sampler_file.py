"""Graphs that are not what the exporter writes: refused with one line before a touch meets them."""

import subprocess
import sys
from collections.abc import Sequence
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
Shape = Sequence[int | str]
ADDED = (helper.make_node("Add", ["flat", "w"], ["poses"]),)
SLOW_S = 120  # for a start of Python, on a busy machine


def graph(
    nodes: Sequence[onnx.NodeProto] = ADDED,
    *weights: TensorProto,
    noise: Shape = (1, "samples", 4),
    z: Shape = (1, TAXELS),
    kind: int = TensorProto.FLOAT,
    names: tuple[str, str, str] = ("z", "live", "noise"),
    layout: str = "",
    functions: Sequence[onnx.FunctionProto] = (),
) -> bytes:
    """A graph that makes `poses` of `flat`, the mean of the noise's steps, and of weights.

    Without nodes and weights of its own it is a sampler: the noise and half a unit.
    """
    weights = weights or (helper.make_tensor("w", kind, [1], [0.5]),)
    inputs = [
        helper.make_tensor_value_info(name, kind, shape)
        for name, shape in zip(names, (z, (1, TAXELS), noise), strict=True)
    ]
    flat = helper.make_node("ReduceMean", [names[2]], ["flat"], axes=[0], keepdims=0)
    poses = helper.make_tensor_value_info("poses", kind, None)
    made = helper.make_graph([flat, *nodes], "sampler", inputs, [poses], weights)
    opset = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    model = helper.make_model(made, opset_imports=opset, ir_version=8, functions=functions)
    if layout:
        helper.set_model_props(model, {"layout": layout})
    return bytes(model.SerializeToString())


def numbers(name: str, *values: int) -> TensorProto:
    return helper.make_tensor(name, TensorProto.INT64, [len(values)], values)


def elsewhere(location: str) -> TensorProto:
    """A weight that lies in another file."""
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1])
    weight.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "4")):
        weight.external_data.add(key=key, value=value)
    return weight


def subgraph(operator: str) -> onnx.NodeProto:
    """A node of an operator that runs a graph of its own; a Loop does so 2^62 times."""
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [
            value("turn", TensorProto.INT64, []),
            value("go", TensorProto.BOOL, []),
            value("x", TensorProto.FLOAT, None),
        ],
        [value("on", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, None)],
    )
    return helper.make_node(operator, ["turns", "yes", "flat"], ["poses"], body=body)


def sampler(content: bytes) -> Sampler:
    return Sampler(content, SKIN, "density", Path("bundle/own.onnx"))


def refusal(content: bytes) -> str:
    with pytest.raises(SetupError) as refused:
        sampler(content)
    assert str(refused.value).startswith("bundle/own.onnx: unusable sampler (")
    assert str(refused.value).isprintable()
    return str(refused.value)


def test_a_sampler_gives_poses() -> None:
    poses = sampler(graph()).propose(
        np.eye(1, TAXELS)[0], np.ones(TAXELS, bool), 30, np.random.default_rng(0)
    )
    assert poses.shape == (30, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", ""),
        (b"junk", ""),
        (graph()[:200], ""),
        (graph(z=(1, TAXELS + 1)), f"is not for a skin of {TAXELS} taxels"),
        (graph(layout='"77"'), f"is for the layout 77, not for {SKIN.name}"),
        (graph(noise=(1, 8, 4)), "noise is not"),
        (graph(noise=(1, "samples", 5)), "noise is not"),
        (graph(noise=("steps", "samples", 4)), "noise is not"),
        (graph(noise=(10**9, "samples", 4)), "noise is not"),
        (graph(names=("z", "live", "seed")), "inputs are not"),
        (graph(kind=TensorProto.DOUBLE), ""),
        (graph([helper.make_node("Nonsense", ["flat", "w"], ["poses"])]), ""),
        (graph(ADDED, helper.make_tensor("w", 1, [1], [np.nan])), "no finite poses"),
        (graph(ADDED, helper.make_tensor("w", 1, [3, 1, 1], [0.0] * 3)), ""),
        (graph(ADDED, elsewhere("../secret.bin")), "names other files as its weights"),
    ],
)
def test_a_graph_that_is_no_sampler_is_one_line(content: bytes, said: str) -> None:
    assert said in refusal(content)


@pytest.mark.parametrize("operator", ["Loop", "Scan", "If"])
@pytest.mark.parametrize("place", ["in the graph", "in a function"])
def test_an_operator_that_runs_a_graph_of_its_own_is_refused(operator: str, place: str) -> None:
    turns = numbers("turns", 2**62)
    turns.ClearField("dims")
    weights = turns, helper.make_tensor("yes", TensorProto.BOOL, [], [True])
    nodes, functions = [subgraph(operator)], []
    if place == "in a function":
        inputs, opset = ["turns", "yes", "flat"], [helper.make_opsetid("", 17)]
        functions = [helper.make_function("own", "Own", inputs, ["poses"], nodes, opset)]
        nodes = [helper.make_node("Own", inputs, ["poses"], domain="own")]
    said = refusal(graph(nodes, *weights, functions=functions))
    assert f"the operator {operator}" in said


def expanded(given: str, *nodes: onnx.NodeProto, shape: tuple[int, ...], result: str) -> bytes:
    """A graph that expands the touch, or a constant, to a tensor `x0` and adds `result`'s most."""
    made = [
        helper.make_node("ReduceMean", ["z"], ["touch"], axes=[1], keepdims=0),
        helper.make_node("Expand", [given, "shape"], ["x0"]),
        *nodes,
        helper.make_node("ReduceMax", [result], ["most"], keepdims=0),
        helper.make_node("Add", ["flat", "most"], ["poses"]),
    ]
    constant = helper.make_tensor("constant", TensorProto.FLOAT, [1], [0.5])
    return graph(made, numbers("shape", *shape), constant)


@pytest.mark.parametrize("given", ["touch", "constant"])
def test_a_graph_that_needs_gigabytes_is_refused_before_it_has_them(given: str) -> None:
    content = expanded(given, shape=(2_200_000_000,), result="x0")
    assert "smaller than requested bytes" in refusal(content)


@pytest.mark.parametrize("given", ["touch", "constant"])
def test_a_graph_that_is_never_done_ends_the_command_with_its_line(
    tmp_path: Path, given: str
) -> None:
    """Minutes of multiplications, with a second for them."""
    turns = [helper.make_node("MatMul", [f"x{i}", "x0"], [f"x{i + 1}"]) for i in range(3000)]
    file = tmp_path / "slow.onnx"
    file.write_bytes(expanded(given, *turns, shape=(2000, 2000), result="x3000"))
    opened = (
        "from pathlib import Path\nfrom taxeld.layout import read\n"
        "from taxeld.proposals import sampler\nsampler.DEADLINE_S = 1\n"
        f"sampler.Sampler.read(Path({str(file)!r}), read.load({SKIN.name!r}), 'density')"
    )
    command = [sys.executable, "-c", opened]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=SLOW_S, check=False)
    assert ended.returncode == 2
    assert ended.stderr.startswith(f"{file}: unusable sampler (it takes longer than 1 s")
    assert ended.stderr.count("\n") == 1


def test_a_graph_of_onnxruntimes_own_format_is_refused(tmp_path: Path) -> None:
    options = ort.SessionOptions()
    options.optimized_model_filepath = str(tmp_path / "own.ort")
    options.add_session_config_entry("session.save_model_format", "ORT")
    ort.InferenceSession(graph(), options, providers=["CPUExecutionProvider"])
    refusal((tmp_path / "own.ort").read_bytes())
