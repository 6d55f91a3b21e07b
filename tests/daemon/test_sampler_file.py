"""Graphs that are not what the exporter writes: refused with one line before a touch meets them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals.sampler import Sampler

SKIN = layouts.load("cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015")
TAXELS = len(SKIN)
Shape = Sequence[int | str]
ADDED = (helper.make_node("Add", ["flat", "w"], ["poses"]),)


def graph(
    nodes: Sequence[onnx.NodeProto] = ADDED,
    *weights: TensorProto,
    noise: Shape = (1, "samples", 4),
    z: Shape = (1, TAXELS),
    kind: int = TensorProto.FLOAT,
    names: tuple[str, str, str] = ("z", "live", "noise"),
    layout: str = "",
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
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if layout:
        helper.set_model_props(model, {"layout": layout})
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
        (graph()[:200], ""),
        (graph(z=(1, TAXELS + 1)), f"is not for a skin of {TAXELS} taxels"),
        (graph(layout='"77"'), f"is for the layout 77, not for {SKIN.name}"),
        (graph(noise=(1, 8, 4)), "noise is not"),
        (graph(noise=(1, "samples", 5)), "noise is not"),
        (graph(noise=("steps", "samples", 4)), "noise is not"),
        (graph(noise=(10**9, "samples", 4)), "noise is not"),
        (graph(names=("z", "live", "seed")), "inputs are not"),
        (graph(kind=TensorProto.DOUBLE), ""),
        (graph([helper.make_node("Loop", ["w", "", "flat"], ["poses"])]), "loops or branches"),
        (graph(ADDED, helper.make_tensor("w", 1, [1], [np.nan])), "no finite poses"),
        (graph(ADDED, helper.make_tensor("w", 1, [3, 1, 1], [0.0] * 3)), ""),
        (graph(ADDED, elsewhere("../secret.bin")), "names other files as its weights"),
    ],
)
def test_a_graph_that_is_no_sampler_is_one_line(content: bytes, said: str) -> None:
    with pytest.raises(SetupError) as refused:
        sampler(content)
    assert str(refused.value).startswith("bundle/own.onnx: unusable sampler (")
    assert str(refused.value).isprintable()
    assert said in str(refused.value)
