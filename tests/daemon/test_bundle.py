"""A bundle or a sampler that cannot be used, or that does not go with another, is one line."""

import json
import re
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from taxeld.config import file
from taxeld.config.tables import FilterConfig, SceneConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle, choice, manifest
from taxeld.proposals.sampler import Sampler

from .conftest import DEPTH_MAX_M

Change = Callable[[Path], object]

SKIN = layouts.load(SkinConfig().layout)
USUAL = FilterConfig()
OF_ALL = USUAL.particles, USUAL.particles_max, USUAL.injected
FAR = np.ones((5, 9, 9), dtype=np.float32)  # m, to an object that is nowhere


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A copy of the shipped box that may be changed."""
    return Path(shutil.copytree(bundle.find("box"), tmp_path / "box"))


def used(*names: object) -> None:
    """Load bundles and open all samplers that may be chosen."""
    found = bundle.load_all(SceneConfig(bundles=tuple(map(str, names))), [SKIN], DEPTH_MAX_M)
    assert [found[-1].open(name) for name in choice.possible(found, USUAL)]


def fault(*names: object) -> str:
    with pytest.raises(SetupError) as refusal:
        used(*names)
    assert str(refusal.value).isprintable()
    return str(refusal.value)


def about(change: Callable[[dict[str, Any]], object] | None = None, **keys: object) -> Change:
    """A change of bundle.json."""

    def made(box: Path) -> None:
        info = json.loads((box / "bundle.json").read_text(encoding="utf-8")) | keys
        if change:
            change(info)
        (box / "bundle.json").write_text(json.dumps(info), encoding="utf-8")

    return made


def sampler(key: str, value: object) -> Change:
    """A change of the first sampler's entry in bundle.json."""
    return about(lambda info: info["samplers"][0].update({key: value}))


def content(name: str, data: bytes) -> Change:
    """Other content of a file."""
    return lambda box: (box / name).write_bytes(data)


def sealed(box: Path) -> None:
    """Have bundle.json name the files as they are now."""
    digests = {path.name: manifest.digest(path.read_bytes()) for path in box.glob("*.[no]*[zx]")}
    about(files=digests)(box)


def flipped(name: str, keep: float = 1.0) -> Change:
    """One bit of a file is another; or it ends early, and was sealed so."""

    def made(box: Path) -> None:
        data = bytearray((box / name).read_bytes())
        data[int(0.6 * len(data))] ^= 0x10 * (keep == 1.0)
        (box / name).write_bytes(data[: int(keep * len(data))])
        if keep < 1.0:
            sealed(box)

    return made


def scene(**values: Any) -> Change:
    """Other arrays in the scene, which was sealed so."""

    def made(box: Path) -> None:
        with np.load(box / "scene.npz") as npz:
            arrays = {name: npz[name] for name in npz.files}
        np.savez_compressed(box / "scene.npz", **(arrays | values if values else {"slices": FAR}))
        sealed(box)

    return made


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flipped("scene.npz"), "scene.npz: is damaged or was changed"),
        (flipped("ddpm-100.onnx"), "ddpm-100.onnx: is damaged or was changed"),
        (lambda box: (box / "scene.npz").unlink(), "scene.npz: No such file"),
        # bundle.json is none
        (content("bundle.json", b""), "bundle.json: Expecting value"),
        (content("bundle.json", b"[]"), "bundle.json: is of format None, not 3"),
        # bundle.json makes no sense
        (about(format=2), "is of format 2, not 3: of another taxeld; build the bundle"),
        (about(lambda info: info.pop("object")), "object: is required; build the bundle again"),
        (about(depth_max_m=0.04), "was built for 0.04; set it to that"),
        (about(lambda info: info["layout"].pop("digest")), "layout.digest: is required"),
        (about(layout={"name": "wrap", "digest": "77"}), "box is for the layout wrap (77), not fo"),
        (sampler("kind", "magic"), "samplers[0].kind: must be one of density, ddpm, not 'magic'"),
        (sampler("file", "other.onnx"), "files has no SHA-256 of 'other.onnx'"),
        (about(files={}), "no SHA-256 of 'scene.npz'"),
        (about(files={"../x": ""}), "'../x' is no file's name"),
        (about(auto=["density-1"]), "auto: no such proposal or sampler"),
        (about(filter={"particles": 1}), "filter.particles: must be 2..100000, not 1"),
        # the scene is none
        (flipped("scene.npz", 0.0), "scene.npz: unusable scene (File is not a zip file"),
        (flipped("scene.npz", 0.5), "scene.npz: unusable scene ("),
        (scene(), "scene.npz: unusable scene ('silhouette"),
        (scene(surface=np.zeros((9, 2))), "surface has the shape (9, 2)"),
        (scene(slices=np.zeros((3, 4))), "slices is no array of 3 dimensions"),
        (scene(origin=np.array(["here", "there"])), "origin is no array"),
        (scene(centre=np.array([np.nan, 0.0])), "centre is not finite"),
        (scene(outline=np.zeros((2, 2))), "no outline"),
        (scene(cell=np.nan), "cell is not within"),
        (scene(symmetry=10**9), "symmetry is not within"),
        (scene(slices=np.zeros((5, 2000, 2000), np.float32)), "arrays take 80"),
        (
            scene(slices=FAR, silhouette=FAR[0], heights=np.linspace(-0.03, 0.03, 5)),
            "no contact with this skin can be made",
        ),
        # a sampler that may be used is none, though another is preferred
        (flipped("density-16.onnx", 0.2), "density-16.onnx: unusable sampler ("),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bundle_that_cannot_be_used_is_one_line(box: Path, change: Change, said: str) -> None:
    change(box)
    assert said in fault(box)


@pytest.mark.parametrize("name", ["party", "n" * 5000])
def test_a_name_of_no_bundle_is_refused(name: str) -> None:
    assert fault("box", name).startswith(f"scene.bundles: no bundle '{name[:10]}")
    with pytest.raises(SetupError, match=r"^scene\.bundle: no bundle"):
        bundle.names(SceneConfig(bundle=name))


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({}, "are both of 003_cracker_box; keep one of the two"),
        ({"object": "a", "depth_max_m": 0.004}, "box for 0.004 m; build both for one .'taxeld-t"),
        ({"object": "a", "layout": {"name": "ball", "digest": "0"}}, "box is for the layout ball"),
    ],
)
def test_objects_that_cannot_be_told_apart_are_refused_in_one_line(
    box: Path, keys: dict[str, object], said: str
) -> None:
    about(**keys)(box)
    assert re.match(rf"scene\.bundles: .*{said}", fault("box", box))


def test_an_object_of_the_name_other_is_named_with_its_directory(box: Path) -> None:
    about(object="other")(box)
    found = bundle.names(SceneConfig(bundles=("drill", str(box))))
    assert found == ("035_power_drill", "box/other")


def test_the_bytes_that_were_compared_are_those_that_are_opened(box: Path) -> None:
    loaded = bundle.load(str(box), SKIN, DEPTH_MAX_M)
    shutil.rmtree(box)
    for name in choice.possible([loaded], USUAL):
        loaded.open(name)


@pytest.mark.parametrize(
    ("names", "text", "expected"),
    [
        (["{box}"], "", (25, 90, 12)),
        (["{box}"], "nudge_m = 0.002", (25, 90, 12)),
        (["{box}"], f"particles = {USUAL.particles}", OF_ALL),
        (["{box}"], "injected = 20", (*OF_ALL[:2], 20)),
        (["drill"], "", OF_ALL),
        (["{box}", "drill"], "", OF_ALL),
    ],
    ids=["it says", "of others", "of one", "of another one", "it does not say", "most counts"],
)
def test_what_was_enough_holds_unless_the_file_gives_any_of_these_keys(
    box: Path, names: list[str], text: str, expected: tuple[int, ...]
) -> None:
    about(filter={"particles": 25, "particles_max": 90, "injected": 12})(box)
    named = [name.format(box=box) for name in names]
    source = '[source]\nkind = "can"\nchannel = "a"\n'
    config = file.parse(f"{source}[scene]\nbundles = {named}\n[filter]\n{text}")
    now = bundle.sized(config, [bundle.manifest_of(name) for name in named]).filter
    assert (now.particles, now.particles_max, now.injected) == expected


SMALL = layouts.load("cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015")
TAXELS, OWN = len(SMALL), Path("bundle/own.onnx")
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


def of_gigabytes() -> bytes:
    """A sampler of some hundred bytes that makes a constant of 4 GB."""
    value = helper.make_tensor("value", TensorProto.FLOAT, [1], [1.0])
    made = helper.make_node("ConstantOfShape", ["w"], ["large"], value=value)
    one = helper.make_node("ReduceMax", ["large"], ["one"], keepdims=0)
    poses = helper.make_node("Add", ["flat", "one"], ["poses"])
    return graph([made, one, poses], helper.make_tensor("w", TensorProto.INT64, [1], [10**9]))


def elsewhere(location: str) -> TensorProto:
    """A weight that lies in another file."""
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1])
    weight.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0"), ("length", "4")):
        weight.external_data.add(key=key, value=value)
    return weight


def test_a_sampler_gives_poses() -> None:
    made, live = Sampler(graph(), SMALL, "density", OWN), np.ones(TAXELS, bool)
    assert made.propose(np.eye(1, TAXELS)[0], live, 30, np.random.default_rng(0)).shape == (30, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (graph()[:200], ""),
        (graph(z=(1, TAXELS + 1)), f"is not for a skin of {TAXELS} taxels"),
        (graph(layout='"77"'), f"is for the layout 77, not for {SMALL.name}"),
        (graph(noise=(1, 8, 4)), "noise is not"),
        (graph(noise=(1, "samples", 5)), "noise is not"),
        (graph(noise=("steps", "samples", 4)), "noise is not"),
        (graph(noise=(10**9, "samples", 4)), "noise is not"),
        (graph(names=("z", "live", "seed")), "inputs are not"),
        (graph(kind=TensorProto.DOUBLE), ""),
        (graph([helper.make_node("Loop", ["w", "", "flat"], ["poses"])]), "loops or branches"),
        (graph(ADDED, helper.make_tensor("w", 1, [1], [np.nan])), "no finite poses"),
        (graph(ADDED, helper.make_tensor("w", 1, [3, 1, 1], [0.0] * 3)), ""),
        (of_gigabytes(), "is smaller than requested bytes of 4000000000"),
        (graph(ADDED, elsewhere("../secret.bin")), "names other files as its weights"),
    ],
)
def test_a_graph_that_is_no_sampler_is_one_line(content: bytes, said: str) -> None:
    with pytest.raises(SetupError, match=rf"^{OWN}: unusable sampler \(.*{said}") as refused:
        Sampler(content, SMALL, "density", OWN)
    assert str(refused.value).isprintable()
