"""A bundle that is damaged, changed or senseless is one line and exit status 2, from `check` as
from `run`."""

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
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle, choice, sampler, seal
from taxeld.proposals.analytic import Projection, Table, check_contacts
from tests.logged import warnings

from ..firmware_protocol.test_cyskin import GOLDEN_SCAN
from .conftest import DEPTH_MAX_M, scene_of

Change = Callable[[Path], None]


@pytest.fixture
def box(tmp_path: Path) -> Path:
    """A copy of the shipped box that may be changed."""
    return Path(shutil.copytree(bundle.find("box"), tmp_path / "box"))


@pytest.fixture
def skin_of_box() -> Layout:
    return layouts.load(SkinConfig().layout)


def configuration(box: Path, name: str | None = None) -> Path:
    place = box.parent
    lines = [f"(1.000000) can0 {line}" for line in GOLDEN_SCAN]
    (place / "frames.log").write_text("\n".join(lines) + "\n", encoding="ascii")
    path = place / "config.toml"
    path.write_text(
        f'[source]\nkind = "replay"\npath = "{place}"\nmodules = [[1, 0xFFF]]\n'
        f"[scene]\nbundle = {json.dumps(name or str(box))}\n"
        '[publish]\nendpoints = []\n[control]\nendpoint = ""\n',
        encoding="utf-8",
    )
    return path


def fault(config: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line that `check` and `run` both end with."""
    said = []
    for command in ("check", "run"):
        assert main([command, str(config)]) == 2
        said.append(capsys.readouterr().err)
    assert said[0] == said[1]
    assert said[0].count("\n") == 1
    return said[0]


def edit(box: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change bundle.json."""
    info = json.loads((box / "bundle.json").read_text(encoding="utf-8"))
    change(info)
    (box / "bundle.json").write_text(json.dumps(info), encoding="utf-8")


def reseal(box: Path) -> None:
    """Have bundle.json name the files as they are: what parses them is asked, not their digests."""
    digests = {path.name: seal.digest(path.read_bytes()) for path in box.glob("*.[no]*[zx]")}
    edit(box, lambda info: info.update(files=digests))


def flip(path: Path, at: float) -> None:
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 0x10
    path.write_bytes(data)


def unpacking(path: Path) -> None:
    """Flip a bit where zlib itself finds it, in the first bytes of what is packed."""
    data = bytearray(path.read_bytes())
    name, extra = int.from_bytes(data[26:28], "little"), int.from_bytes(data[28:30], "little")
    data[30 + name + extra] ^= 0x06  # the kind of the first block
    path.write_bytes(data)


def rewrite(box: Path, **values: Any) -> None:
    """Replace arrays of the scene."""
    with np.load(box / "scene.npz") as npz:
        arrays = {name: npz[name] for name in npz.files}
    np.savez(box / "scene.npz", **(arrays | values))


def scene_with(**values: Any) -> Change:
    return lambda box: rewrite(box, **{k: np.asarray(v) for k, v in values.items()})


@pytest.mark.parametrize(
    "name", ["scene.npz", "density-64.onnx", "density-16.onnx", "ddpm-100.onnx"]
)
def test_one_flipped_bit_in_any_file_is_found(
    box: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    flip(box / name, 0.6)
    assert f"{name}: is damaged or was changed" in fault(configuration(box), capsys)


@pytest.mark.parametrize("name", ["scene.npz", "density-16.onnx"])
def test_a_missing_file_is_found(box: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    (box / name).unlink()
    assert f"{name}: no such file" in fault(configuration(box), capsys)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda box: flip(box / "scene.npz", 0.5), "unreadable scene"),
        (lambda box: (box / "scene.npz").write_bytes(b""), "unreadable scene"),
        (scene_with(surface=np.zeros((9, 2))), "surface has the shape (9, 2)"),
        (scene_with(slices=np.zeros((3, 4))), "slices is no array of 3 dimensions"),
        (scene_with(slices=np.zeros((0, 4, 4))), "slices has the shape (0, 4, 4)"),
        (scene_with(outline=np.zeros((2, 2))), "no outline"),
        (scene_with(centre=[np.nan, 0.0]), "centre is not finite"),
        (scene_with(origin=[0.0, np.inf]), "origin is not finite"),
        (scene_with(origin=["here", "there"]), "origin is no array"),
        (scene_with(origin=[np.nan, 0.0]), "origin is not finite"),
        (scene_with(centre=[0.0, 0.0, 0.0]), "centre has the shape (3,)"),
        (lambda box: unpacking(box / "scene.npz"), "unreadable scene (Error -3 while decompress"),
        (scene_with(cell=np.nan), "cell is not within"),
        (scene_with(symmetry=10**9), "symmetry is not within"),
        (scene_with(cell=[1.0, 2.0]), "unreadable scene"),
        (lambda box: np.savez(box / "scene.npz", slices=np.zeros(3)), "lacks cell, centre"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_scene_that_is_none_is_found(
    box: Path, capsys: pytest.CaptureFixture[str], change: Change, said: str
) -> None:
    change(box)
    reseal(box)
    err = fault(configuration(box), capsys)
    assert said in err
    assert "scene.npz" in err


def test_a_scene_that_the_skin_cannot_touch_is_found_and_hangs_nothing(
    box: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(box / "scene.npz") as npz:
        shape = npz["slices"].shape
    far = np.ones(shape, dtype=np.float32)
    rewrite(box, slices=far, silhouette=far[0])
    reseal(box)
    assert "no contact with this skin can be made" in fault(configuration(box), capsys)


def test_what_draws_contacts_gives_up_where_there_are_none(skin: Layout) -> None:
    scene = scene_of(lambda x, _y: np.ones_like(x), skin, symmetry=1)
    model = ObservationModel(scene, skin, DEPTH_MAX_M)
    with pytest.raises(SetupError, match="no contact"):
        check_contacts(model)
    with pytest.raises(SetupError, match="no contact"):
        Table(model, size=2)
    z, live = np.eye(1, len(skin))[0], np.ones(len(skin), dtype=bool)
    assert Projection(model).propose(z, live, 2, np.random.default_rng(0)).shape == (0, 3)


def first(key: str, value: object) -> Callable[[dict[str, Any]], object]:
    return lambda info: info["samplers"][0].update({key: value})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda info: info.update(format=2) or info.pop("files"), "'taxeld-train seal'"),
        (lambda info: info.update(format=4), "is not of bundle format 3"),
        (lambda info: info.update(auto=[[]]), "auto: no such proposal"),
        (lambda info: info.update(auto=["table", "table"]), "auto: no such proposal"),
        (lambda info: info.update(depth_max_m=float("nan")), "NaN is no number"),
        (lambda info: info.update(depth_max_m=10**400), "depth_max_m is missing or no number"),
        (lambda info: info.update(object="a\nb"), "object is missing"),
        (lambda info: info.update(object="mug " * 1000), "object is missing"),
        (lambda info: info.update(height_m=[[]]), "height_m is missing"),
        (lambda info: info.update(layout=[]), "layout needs"),
        (lambda info: info.update(layout={"name": "a\nb", "digest": ""}), "layout needs"),
        (lambda info: info.update(samplers={}), "samplers is missing"),
        (lambda info: info["samplers"][0].pop("flops"), "samplers[0].flops"),
        (first("flops", True), "samplers[0].flops"),
        (first("flops", -1), "samplers[0].flops"),
        (lambda info: info["samplers"][0].pop("name"), "samplers[0].name"),
        (first("name", "table"), "samplers[0].name"),
        (first("name", "density-16"), "samplers[2].name"),
        (first("name", "a\nb"), "samplers[0].name"),
        (first("name", "n" * 1000), "samplers[0].name"),
        (first("kind", "magic"), "samplers[0].kind"),
        (first("file", "../box/density-64.onnx"), "samplers[0].file"),
        (first("file", "other.onnx"), "samplers[0].file"),
        (lambda info: info["files"].pop("scene.npz"), "files needs"),
        (lambda info: info["files"].update({"scene.npz": 5}), "files.scene.npz is no SHA-256"),
        (lambda info: info["files"].update({"../x": "0" * 64}), "is no file's name"),
        (lambda info: info["files"].update({"bundle.json": "0" * 64}), "is no file's name"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bundle_json_that_makes_no_sense_is_found(
    box: Path, capsys: pytest.CaptureFixture[str], change: Callable[[dict[str, Any]], object],
    said: str,
) -> None:  # fmt: skip
    edit(box, change)
    err = fault(configuration(box), capsys)
    assert said in err
    assert "bundle.json" in err


@pytest.mark.parametrize(
    "text",
    [b"[" * 100_000, b'{"format":' * 100_000, b" " * 2_000_000, b"[]", b"3", b"\xff", b"9" * 9999],
)
def test_a_bundle_json_that_is_none_is_found(
    box: Path, capsys: pytest.CaptureFixture[str], text: bytes
) -> None:
    (box / "bundle.json").write_bytes(text)
    assert "bundle.json" in fault(configuration(box), capsys)


@pytest.mark.parametrize("name", ["no\nsuch", "\0", "n" * 5000])
def test_a_name_that_cannot_be_a_path_is_no_bundle(
    box: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert fault(configuration(box, name), capsys).startswith("scene.bundle: no bundle")


@pytest.mark.parametrize("name", ["density-16", "ddpm-100"])
def test_a_broken_sampler_is_found_though_another_is_preferred(
    box: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (box / f"{name}.onnx").write_bytes(b"junk")
    reseal(box)
    assert f"{name}.onnx: unusable sampler" in fault(configuration(box), capsys)


def rename_input(model: onnx.ModelProto) -> None:
    model.graph.input[0].name = "touch"


def fix_samples(model: onnx.ModelProto) -> None:
    model.graph.input[2].type.tensor_type.shape.dim[1].dim_value = 100


def widen(model: onnx.ModelProto) -> None:
    for given in model.graph.input[:2]:
        given.type.tensor_type.shape.dim[1].dim_value = 79


def of_another_layout(model: onnx.ModelProto) -> None:
    (entry,) = (entry for entry in model.metadata_props if entry.key == "layout")
    entry.value = json.dumps("77")


@pytest.mark.parametrize("name", ["density-64", "ddpm-100"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (rename_input, "its inputs are not z, live and noise"),
        (fix_samples, "its noise is not (steps, any number of samples, 4)"),
        (widen, "it is not for a skin of 80 taxels"),
        (
            of_another_layout,
            "it is for the layout 77, not for cylinder:rows=5,columns=16,radius_m=",
        ),
    ],
)
def test_a_sampler_of_another_form_or_skin_is_found_whether_it_would_be_opened_or_not(
    box: Path, capsys: pytest.CaptureFixture[str], name: str,
    change: Callable[[onnx.ModelProto], None], said: str,
) -> None:  # fmt: skip
    path = box / f"{name}.onnx"
    model = onnx.load(path)
    change(model)
    onnx.save(model, path)
    reseal(box)
    err = fault(configuration(box), capsys)
    assert err.startswith(f"{path}: unusable sampler ({said}")


@pytest.mark.parametrize("keep", [0.2, 0.999])
def test_a_sampler_that_was_cut_short_is_found_though_another_is_preferred(
    box: Path, capsys: pytest.CaptureFixture[str], keep: float
) -> None:
    path = box / "ddpm-100.onnx"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])
    reseal(box)
    assert "ddpm-100.onnx: unusable sampler (it is cut short)" in fault(configuration(box), capsys)


def test_check_opens_what_run_opens_and_nothing_that_auto_cannot_come_to(
    box: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[int] = []
    whole = sampler._session

    def counted(graph: bytes) -> Any:
        opened.append(len(graph))
        return whole(graph)

    monkeypatch.setattr(sampler, "_session", counted)
    config = configuration(box)
    assert main(["check", str(config)]) == 0
    sizes = [(box / name).stat().st_size for name in ("density-64.onnx", "density-16.onnx")]
    assert opened == sizes
    opened.clear()
    assert main(["run", str(config)]) == 0
    assert opened == sizes
    assert warnings(capsys.readouterr().err) == []


def test_auto_comes_to_no_sampler_that_takes_more_than_one_before_it(skin_of_box: Layout) -> None:
    loaded = bundle.load("box", skin_of_box, DEPTH_MAX_M)
    order = ["density-16", "table", "ddpm-100", "density-64", "manifold"]
    loaded = replace(loaded, info=loaded.info | {"auto": order})
    assert loaded.choices == ["density-16", "table", "manifold"]
    assert loaded.cheaper("ddpm-100") == ["density-16"]
    loaded = replace(loaded, info=loaded.info | {"auto": order[::-1]})
    assert loaded.choices == ["manifold", "density-64", "table", "density-16"]
    assert loaded.cheaper("ddpm-100") == ["density-64", "density-16"]
    assert loaded.cheaper("density-16") == []


def test_a_bundle_for_another_skin_is_named_with_its_own(
    box: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(box, lambda info: info["layout"].update(name="wrap", digest="77"))
    assert "is for the layout wrap (77), not for cylinder" in fault(configuration(box), capsys)


def test_what_was_compared_is_what_is_parsed(
    box: Path, monkeypatch: pytest.MonkeyPatch, skin_of_box: Layout
) -> None:
    read: list[Path] = []
    whole = seal.read

    def counted(path: Path) -> bytes:
        read.append(path)
        return whole(path)

    monkeypatch.setattr(seal, "read", counted)
    loaded = bundle.load(str(box), skin_of_box, DEPTH_MAX_M)
    for path in box.iterdir():
        path.write_bytes(b"changed since")
    choice.open_all(loaded, FilterConfig())
    assert sorted(read) == sorted(box.iterdir())  # each once


def test_a_run_opens_all_that_it_may_draw_from(skin_of_box: Layout) -> None:
    loaded = bundle.load("box", skin_of_box, DEPTH_MAX_M)
    opened = {
        name: set(choice.open_all(loaded, replace(FilterConfig(), **keys)))
        for name, keys in {
            "auto": {}, "ddpm": {"proposal": "ddpm"}, "16": {"sampler": "density-16"},
            "table": {"proposal": "table"},
        }.items()
    }  # fmt: skip
    assert opened["auto"] == {"density-64", "density-16", "table", "manifold", "projection"}
    assert opened["ddpm"] == {"ddpm-100", "density-64", "density-16", "table"}
    assert opened["16"] == {"density-16", "table"}
    assert opened["table"] == {"table"}
