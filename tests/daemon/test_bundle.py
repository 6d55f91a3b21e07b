"""A bundle that cannot be used is one line and exit status 2, from `check` as from `run`."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from taxeld.cli import main
from taxeld.config.file import load
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle, choice, manifest
from taxeld.proposals.analytic import Projection, Table, check_contacts
from taxeld.service.loop import Daemon
from tests.rig.commands import refused
from tests.rig.logged import warnings
from tests.rig.recorded import golden, write_golden

from .conftest import DEPTH_MAX_M, scene_of

Change = Callable[[Path], object]


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A copy of the shipped box that may be changed."""
    return Path(shutil.copytree(bundle.find("box"), tmp_path / "box"))


@pytest.fixture
def skin_of_box() -> Layout:
    return layouts.load(SkinConfig().layout)


def configured(box: Path, name: str = "") -> Path:
    write_golden(box.parent)
    return golden(box.parent, scene={"bundle": name or box})


def fault(config: Path) -> str:
    """The one line that `check` and `run` both end with."""
    checked, ran = (refused(command, config) for command in ("check", "run"))
    assert checked == ran
    return ran


def sealed(box: Path) -> None:
    """Have bundle.json name the files as they are now."""
    digests = {path.name: manifest.digest(path.read_bytes()) for path in box.glob("*.[no]*[zx]")}
    about(lambda info: info.update(files=digests))(box)


def about(change: Callable[[dict[str, Any]], object]) -> Change:
    """A change of bundle.json."""

    def made(box: Path) -> None:
        info = json.loads((box / "bundle.json").read_text(encoding="utf-8"))
        change(info)
        (box / "bundle.json").write_text(json.dumps(info), encoding="utf-8")

    return made


def sampler(key: str, value: object) -> Change:
    """A change of the first sampler's entry in bundle.json."""
    return about(lambda info: info["samplers"][0].update({key: value}))


def content(name: str, data: bytes) -> Change:
    """Other content of a file."""
    return lambda box: (box / name).write_bytes(data)


def flipped(name: str) -> Change:
    """One bit of a file is another."""

    def made(box: Path) -> None:
        data = bytearray((box / name).read_bytes())
        data[int(0.6 * len(data))] ^= 0x10
        (box / name).write_bytes(data)

    return made


def cut_short(name: str, keep: float) -> Change:
    """A file that ends early, and was sealed so."""

    def made(box: Path) -> None:
        data = (box / name).read_bytes()
        (box / name).write_bytes(data[: int(keep * len(data))])
        sealed(box)

    return made


def scene(**values: Any) -> Change:
    """Other arrays in the scene, which was sealed so."""

    def made(box: Path) -> None:
        with np.load(box / "scene.npz") as npz:
            arrays = {name: npz[name] for name in npz.files}
        np.savez(box / "scene.npz", **(arrays | values))
        sealed(box)

    return made


def of_another_skin(box: Path) -> None:
    """The first sampler's file names another layout."""
    model = onnx.load(box / "density-64.onnx")
    (entry,) = (entry for entry in model.metadata_props if entry.key == "layout")
    entry.value = json.dumps("77")
    onnx.save(model, box / "density-64.onnx")
    sealed(box)


def without_all_arrays_but_one(box: Path) -> None:
    np.savez(box / "scene.npz", slices=np.zeros(3))
    sealed(box)


FAR = np.ones((5, 9, 9), dtype=np.float32)  # m, to an object that is nowhere


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flipped("scene.npz"), "scene.npz: is damaged or was changed"),
        (flipped("ddpm-100.onnx"), "ddpm-100.onnx: is damaged or was changed"),
        (lambda box: (box / "scene.npz").unlink(), "scene.npz: No such file"),
        (lambda box: (box / "density-16.onnx").unlink(), "density-16.onnx: No such file"),
        # bundle.json is none
        (content("bundle.json", b""), "bundle.json: Expecting value"),
        (content("bundle.json", b"[]"), "bundle.json: is of format None, not 3"),
        (content("bundle.json", b"\xff"), "bundle.json: 'utf-8' codec"),
        (content("bundle.json", b"[" * 100_000), "bundle.json: maximum recursion"),
        (content("bundle.json", b"9" * 9999), "bundle.json: Exceeds the limit"),
        # bundle.json makes no sense
        (
            about(lambda info: info.update(format=2)),
            "is of format 2, not 3 ('taxeld-train seal' turns 2 into 3)",
        ),
        (about(lambda info: info.update(format=4)), "is of format 4, not 3"),
        (about(lambda info: info.pop("object")), "object: is required"),
        (about(lambda info: info.update(object="a\nb")), "object: must be a line of text, not"),
        (about(lambda info: info.update(height_m=10**400)), "height_m: must be a number, not 1"),
        (
            about(lambda info: info.update(depth_max_m=np.nan)),
            "depth_max_m: must be a number, not",
        ),
        (about(lambda info: info.update(depth_max_m=0.04)), "was built for 0.04; set it to that"),
        (about(lambda info: info.update(layout=[])), "layout: must be a table, not []"),
        (about(lambda info: info["layout"].pop("digest")), "layout.digest: is required"),
        (
            about(lambda info: info["layout"].update(name="wrap", digest="77")),
            "box is for the layout wrap (77), not for cylinder:rows=5,columns=16",
        ),
        (about(lambda info: info.update(samplers={})), "samplers: must be a list, not {}"),
        (sampler("flops", "many"), "samplers[0].flops: must be a number, not 'many'"),
        (sampler("kind", "magic"), "samplers[0].kind: must be one of density, ddpm, not 'magic'"),
        (sampler("file", "other.onnx"), "files has no SHA-256 of 'other.onnx'"),
        (about(lambda info: info["files"].pop("scene.npz")), "no SHA-256 of 'scene.npz'"),
        (about(lambda info: info["files"].update({"../x": ""})), "'../x' is no file's name"),
        (about(lambda info: info["files"].update({"\0": ""})), "'\\x00' is no file's name"),
        (about(lambda info: info.update(auto=["density-1"])), "auto: no such proposal or sampler"),
        # the scene is none
        (cut_short("scene.npz", 0.0), "scene.npz: unusable scene (No data"),
        (cut_short("scene.npz", 0.5), "scene.npz: unusable scene ("),
        (without_all_arrays_but_one, "scene.npz: unusable scene ('silhouette"),
        (scene(surface=np.zeros((9, 2))), "surface has the shape (9, 2)"),
        (scene(slices=np.zeros((3, 4))), "slices is no array of 3 dimensions"),
        (scene(origin=np.array(["here", "there"])), "origin is no array"),
        (scene(centre=np.array([np.nan, 0.0])), "centre is not finite"),
        (scene(outline=np.zeros((2, 2))), "no outline"),
        (scene(cell=np.nan), "cell is not within"),
        (scene(cell=np.ones(2)), "scene.npz: unusable scene (can only convert"),
        (scene(symmetry=10**9), "symmetry is not within"),
        (
            scene(slices=FAR, silhouette=FAR[0], heights=np.linspace(-0.03, 0.03, 5)),
            "no contact with this skin can be made",
        ),
        # a sampler that may be used is none, though another is preferred
        (cut_short("density-16.onnx", 0.0), "density-16.onnx: unusable sampler ("),
        (cut_short("density-16.onnx", 0.2), "density-16.onnx: unusable sampler ("),
        (cut_short("density-16.onnx", 0.999), "density-16.onnx: unusable sampler ("),
        (of_another_skin, "unusable sampler (it is for the layout 77, not for cylinder:rows=5"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bundle_that_cannot_be_used_is_one_line(box: Path, change: Change, said: str) -> None:
    change(box)
    assert said in fault(configured(box))


@pytest.mark.parametrize("name", ["nosuch", "n" * 5000])
def test_a_name_that_cannot_be_a_path_is_no_bundle(box: Path, name: str) -> None:
    assert fault(configured(box, name)).startswith("scene.bundle: no bundle")


def test_a_sampler_that_the_configuration_cannot_come_to_is_not_opened(
    box: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut_short("ddpm-100.onnx", 0.2)(box)
    assert main(["check", str(configured(box))]) == 0
    Daemon(load(configured(box))).close()
    assert warnings(capsys.readouterr().err) == []


def test_the_bytes_that_were_compared_are_those_that_are_opened(
    box: Path, skin_of_box: Layout
) -> None:
    loaded = bundle.load(str(box), skin_of_box, DEPTH_MAX_M)
    for path in box.iterdir():
        path.write_bytes(b"changed since")
    for name in choice.possible(loaded, FilterConfig()):
        loaded.open(name)


def test_what_draws_contacts_gives_up_where_there_are_none(skin: Layout) -> None:
    nowhere = scene_of(lambda x, _y: np.ones_like(x), skin, symmetry=1)
    model = ObservationModel(nowhere, skin, DEPTH_MAX_M)
    with pytest.raises(SetupError, match="no contact"):
        check_contacts(model)
    with pytest.raises(SetupError, match="no contact"):
        Table(model, size=2)
    z, live = np.eye(1, len(skin))[0], np.ones(len(skin), dtype=bool)
    assert Projection(model).propose(z, live, 2, np.random.default_rng(0)).shape == (0, 3)


def test_auto_comes_to_no_sampler_that_takes_more_than_one_before_it(skin_of_box: Layout) -> None:
    loaded = bundle.load("box", skin_of_box, DEPTH_MAX_M)
    order = ["density-16", "table", "ddpm-100", "density-64", "manifold"]
    loaded = replace(loaded, manifest=replace(loaded.manifest, auto=order))
    assert loaded.choices == ["density-16", "table", "manifold"]
    loaded = replace(loaded, manifest=replace(loaded.manifest, auto=order[::-1]))
    assert loaded.choices == ["manifold", "density-64", "table", "density-16"]


@pytest.mark.parametrize(
    ("named", "may_be_chosen"),
    [
        ("auto", {"density-64", "density-16", "table", "manifold", "projection"}),
        ("ddpm", {"ddpm-100"}),
        ("table", {"table"}),
    ],
)
def test_a_check_opens_all_that_may_be_chosen_on_any_machine(
    skin_of_box: Layout, named: str, may_be_chosen: set[str]
) -> None:
    loaded = bundle.load("box", skin_of_box, DEPTH_MAX_M)
    assert set(choice.possible(loaded, FilterConfig(proposal=named))) == may_be_chosen
