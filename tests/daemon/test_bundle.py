"""A bundle or a sampler that cannot be used, or that does not go with another, is one line."""

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx.parser
import pytest

from taxeld.config import file
from taxeld.config.tables import FilterConfig, SceneConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.proposals import bundle, choice, manifest
from taxeld.proposals.sampler import Sampler
from tests.rig.commands import refuses

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


def sealed(box: Path) -> None:
    """Have bundle.json name the files as they are now."""
    digests = {path.name: manifest.digest(path.read_bytes()) for path in box.glob("*.[no]*[zx]")}
    about(files=digests)(box)


def content(name: str, of: Callable[[bytes], bytes], *, seals: bool = True) -> Change:
    """Other content of a file, which was sealed so."""

    def made(box: Path) -> None:
        (box / name).write_bytes(of((box / name).read_bytes()))
        if seals:
            sealed(box)

    return made


def flipped(name: str) -> Change:
    """The last byte of a file is another."""
    return content(name, lambda data: data[:-1] + bytes([data[-1] ^ 0x10]), seals=False)


def scene(**values: Any) -> Change:
    """Other arrays in the scene, or one that lacks, which was sealed so."""

    def made(data: bytes) -> bytes:
        with np.load(io.BytesIO(data)) as npz, io.BytesIO() as file:
            arrays = {name: v for name, v in ({**npz} | values).items() if v is not None}
            np.savez_compressed(file, **arrays)
            return file.getvalue()

    return content("scene.npz", made)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flipped("scene.npz"), "scene.npz: is damaged or was changed"),
        (flipped("ddpm-100.onnx"), "ddpm-100.onnx: is damaged or was changed"),
        (lambda box: (box / "scene.npz").unlink(), "scene.npz: No such file"),
        # bundle.json is none
        (content("bundle.json", lambda _: b"", seals=False), "bundle.json: Expecting value"),
        (
            content("bundle.json", lambda _: b"[]", seals=False),
            "bundle.json: is of format None, not 3",
        ),
        # bundle.json makes no sense
        (about(format=2), "is of format 2, not 3: of another taxeld; build the bundle"),
        (about(grid_error_mm={}), "grid_error_mm: unknown key; known: format, object"),
        (sampler("flops", 9), "samplers[0].flops: unknown key"),
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
        (content("scene.npz", lambda _: b""), "scene.npz: unusable scene (File is not a zip file"),
        (content("scene.npz", lambda data: data[: len(data) // 2]), "scene.npz: unusable scene ("),
        (scene(silhouette=None), "scene.npz: unusable scene ('silhouette"),
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
        (
            content("density-64.onnx", lambda data: data[: len(data) // 5]),
            "density-64.onnx: unusable sampler (",
        ),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bundle_that_cannot_be_used_is_one_line(box: Path, change: Change, said: str) -> None:
    change(box)
    assert said in fault(box)


@pytest.mark.parametrize("name", ["party", "n" * 5000])
def test_a_name_of_no_bundle_is_refused(name: str) -> None:
    assert fault("box", name).startswith(f"scene.bundles: no bundle '{name[:10]}")
    refuses(r"^scene\.bundle: no bundle", bundle.names, SceneConfig(bundle=name))


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


SMALL, OWN = layouts.load("cylinder:rows=2,columns=8,radius_m=0.04,pitch_m=0.015"), Path("own.onnx")
SAMPLER = """<ir_version: 8, opset_import: ["" : 17], metadata_props: ["layout": "null"]>
sampler (float[1,16] z, float[1,16] live, float[1,samples,4] noise) => (float[samples,4] poses)
<float[1] w = {0.5}> {
    flat = ReduceMean <axes = [0], keepdims = 0> (noise)
    poses = Add (flat, w)
}"""
W = "float[1] w = {0.5}"
OF_GIGABYTES = """int64[1] n = {1000000000}> {
    large = ConstantOfShape (n)
    w = ReduceMax <keepdims = 0> (large)"""


def graph(old: str = "", new: str = "") -> bytes:
    """A graph whose poses are the noise and half a unit, with a change of its text."""
    return bytes(onnx.parser.parse_model(SAMPLER.replace(old, new)).SerializeToString())


def test_a_sampler_gives_poses() -> None:
    made, live = Sampler(graph(), SMALL, "density", OWN), np.ones(16, bool)
    assert made.propose(np.eye(1, 16)[0], live, 30, np.random.default_rng(0)).shape == (30, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (graph()[:200], ""),
        (graph("float[1,16] z", "float[1,17] z"), "is not for a skin of 16 taxels"),
        (graph('"null"', '"77"'), f"is for the layout 77, not for {SMALL.name}"),
        (graph("[1,samples,4]", "[1,8,4]"), "noise is not"),
        (graph("[1,samples,4]", "[1,samples,5]"), "noise is not"),
        (graph("[1,samples,4]", "[steps,samples,4]"), "noise is not"),
        (graph("[1,samples,4]", "[1000000000,samples,4]"), "noise is not"),
        (graph("noise", "seed"), "inputs are not"),
        (graph("float", "double"), ""),
        (graph("Add (flat, w)", "Loop (w, , flat)"), "loops or branches"),
        (graph("0.5", "nan"), "no finite poses"),
        (graph(W, "float[3,1,1] w = {0, 0, 0}"), ""),
        (graph(f"{W}> {{", OF_GIGABYTES), "is smaller than requested bytes of 4000000000"),
        (
            graph(W, 'float[1] w = ["location": "../x.bin", "offset": "0", "length": "4"]'),
            "names other files as its weights",
        ),
    ],
)
def test_a_graph_that_is_no_sampler_is_one_line(content: bytes, said: str) -> None:
    refuses(rf"^{OWN}: unusable sampler \(.*{said}", Sampler, content, SMALL, "density", OWN)
