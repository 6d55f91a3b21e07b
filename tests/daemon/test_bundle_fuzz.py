"""Whatever the files of a bundle hold, they are used or refused with one line; nothing else.

The digests in bundle.json catch what changes by accident. Here the parsers behind them are asked.
"""

import io
import json
from dataclasses import fields
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from taxeld.model.scene import Scene
from taxeld.proposals import manifest, scene_file
from taxeld.proposals.sampler import Sampler

from ..readers import NOWHERE, SHIPPED, loaded, manifest_used, scene_used, used_or_refused

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
    | st.sampled_from(["table", "density-16", "auto", "../x", "scene.npz", 10**400, 2**63]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=5,
)  # fmt: skip
places = st.floats(0.0, 1.0, exclude_max=True)
odd_numbers = st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1e-300, 1e300, 1e9, 3.0])


@st.composite
def damaged(draw: st.DrawFn, name: str) -> bytes:
    """The content of a shipped file, with some bytes changed, or cut short."""
    data = bytearray((SHIPPED / name).read_bytes())
    edge = min(2000, len(data) // 2)  # headers, names and directories stand at the edges
    spans = draw(st.sampled_from([(0, edge), (len(data) - edge, edge), (0, len(data))]))
    for place, byte in draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=20)):
        data[spans[0] + int(place * spans[1])] = byte
    return bytes(data[: int(draw(places | st.just(1.0)) * len(data))])


@settings(max_examples=150, deadline=None)
@given(damaged("scene.npz"))
def test_any_bytes_are_a_scene_or_one_line(data: bytes) -> None:
    used_or_refused(lambda: scene_used(scene_file.parse(data, NOWHERE)))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_arrays_are_a_scene_or_one_line(data: st.DataObject) -> None:
    scene = loaded().model.scene
    arrays = {f.name: np.array(getattr(scene, f.name)) for f in fields(Scene)}
    for name in data.draw(
        st.lists(st.sampled_from(sorted(arrays)), min_size=1, max_size=3, unique=True)
    ):
        array = arrays[name]
        change = data.draw(st.sampled_from(["value", "all", "shape", "kind"]))
        if change == "value" and array.size:
            array = array.astype(np.float64)
            array.flat[int(data.draw(places) * array.size)] = data.draw(odd_numbers)
        elif change == "all":
            array = np.full(array.shape, data.draw(odd_numbers))
        elif change == "shape":
            array = array.flatten()[: data.draw(st.integers(0, 20))]
            array = array.reshape(data.draw(st.sampled_from([(-1,), (1, -1), (-1, 1, 1)])))
        elif change == "kind":
            array = array.astype(data.draw(st.sampled_from(["U4", "c8", "i4", "f2", ">f8", "?"])))
        arrays[name] = array
    packed = io.BytesIO()
    np.savez(packed, **arrays)  # type: ignore[arg-type]
    used_or_refused(lambda: scene_used(scene_file.parse(packed.getvalue(), NOWHERE)))


@settings(max_examples=100, deadline=None)
@given(damaged("density-16.onnx"))
def test_any_bytes_are_a_sampler_or_one_line(data: bytes) -> None:
    used_or_refused(lambda: Sampler(data, loaded().model.layout, "density", NOWHERE))


@settings(max_examples=100, deadline=None)
@given(damaged("ddpm-100.onnx") | st.binary(max_size=100))
def test_any_bytes_are_looked_at_without_opening_them_or_one_line(data: bytes) -> None:
    used_or_refused(lambda: Sampler.check(data, loaded().model.layout, NOWHERE))


@settings(max_examples=200, deadline=None)
@given(damaged("bundle.json") | st.binary(max_size=100))
def test_any_bytes_are_a_bundle_json_or_one_line(data: bytes) -> None:
    used_or_refused(lambda: manifest_used(manifest.parse(data, NOWHERE)))


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_values_are_a_bundle_json_or_one_line(data: st.DataObject) -> None:
    info = json.loads((SHIPPED / "bundle.json").read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        inside: Any = info
        while True:
            keys = list(range(len(inside)) if isinstance(inside, list) else inside)
            if not keys:
                break
            key = data.draw(st.sampled_from(keys))
            if isinstance(inside[key], list | dict) and data.draw(st.booleans()):
                inside = inside[key]
                continue
            inside[key] = data.draw(json_values)
            break
    used_or_refused(lambda: manifest_used(manifest.parse(json.dumps(info).encode(), NOWHERE)))
