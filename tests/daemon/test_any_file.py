"""Whatever the files hold that the project reads: a value or one line, nothing else, no hang."""

import contextlib
import io
import json
import logging
import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from logging.handlers import BufferingHandler
from pathlib import Path

import numpy as np
import pytest
from zmq.auth import create_certificates

from taxeld.config.file import load
from taxeld.config.tables import FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.observation import ObservationModel
from taxeld.model.symmetry import PoseMetric
from taxeld.proposals import bundle, manifest
from taxeld.proposals.analytic import Manifold, Projection, check_contacts
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.sampler import Sampler
from taxeld.source import session
from taxeld.stream import curve, messages
from taxeld_hil.scenario import scenario
from tests.rig.skins import table_of

from .test_layout_files import document

ROOT = Path(__file__).parents[2]
RECORDED = ROOT / "tests" / "daemon" / "session"
SHIPPED = bundle.find("box")
MOST = 1100  # characters of a line
PROPOSALS = ("auto", "density", "ddpm", "table", "manifold", "projection")
TOKENS = [  # what breaks readers
    *(b"9" * 400, b"9" * 5000, b"0x" + b"f" * 5000, b"-1", b"1e999", b"nan", b"inf", b"null"),
    *(b"[" * 2000, b"{" * 2000, b'{"a":' * 500, b"[[]]", b"\0", b"\n", b"\r", b"\xff\xfe", b'"'),
    *(b"\x1b[31m", b"#", b",", b"=", b"LOBJ", b"\x1f\x8b\x08", b" " * 5000, b"x" * 70_000),
]


@dataclass(frozen=True, slots=True)
class Reader:
    """What reads a file by its path, and whole files of its kind."""

    use: Callable[[Path], object]  # raises SetupError; may put a line into the log
    samples: Callable[[Path], list[bytes]]  # which may be made in a directory
    examples: int = 60  # changed files of the tests


@cache
def loaded() -> Bundle:
    """The shipped box."""
    return bundle.load("box", layouts.load(SkinConfig().layout), 0.005)


def used_or_refused(use: Callable[[], object]) -> None:
    """It ends, and what a user sees of it is one line; of a log, one on damage, and one on modules
    that are assumed."""
    said, printed, log = [""], io.StringIO(), BufferingHandler(1000)
    logging.getLogger("taxeld").addHandler(log)
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        try:
            use()
        except SetupError as error:
            said = getattr(error, "faults", [str(error)])
        finally:
            logging.getLogger("taxeld").removeHandler(log)
    logged = [record.getMessage() for record in log.buffer]
    for line in (*said, *logged):
        assert line.isprintable(), repr(line)
        assert len(line) <= MOST
    assert len(logged) <= 1 + ("are assumed" in "".join(logged))
    assert printed.getvalue() == ""


def scene_used(path: Path) -> None:
    """All that a start computes of a scene."""
    scene = manifest.parse_scene(path.read_bytes(), path.parent)
    model, rng = ObservationModel(scene, loaded().model.layout, 0.005), np.random.default_rng(0)
    check_contacts(model)
    z, live = np.eye(1, len(model.layout))[0], np.ones(len(model.layout), bool)
    drawn = [make(model).propose(z, live, 5, rng).sum() for make in (Projection, Manifold)]
    assert np.isfinite([*drawn, PoseMetric(scene).arm_m, scene.size, scene.mean_radius]).all()


def manifest_used(path: Path) -> None:
    """All that is asked of bundle.json after it was read."""
    found = replace(loaded(), manifest=manifest.parse(path.read_bytes(), path.parent))
    for name in (*PROPOSALS, *found.order):
        used_or_refused(lambda name=name: found.resolve(name))  # type: ignore[misc]
    names = [sampler.name for sampler in found.manifest.samplers]
    assert [*map(found.resolve, names)] == names
    messages.info(found.model.layout, bundle.scenes([found]), str(FilterConfig()))


def layout_used(path: Path) -> None:
    skin = layouts.read(str(path))
    assert len(skin) == len(set(skin.uid.tolist())) > 0
    assert np.isfinite([*skin.position_m, *skin.frame[:, :3]]).all()


def session_used(path: Path) -> None:
    """A recorded session of which one file is another."""
    list(session.arrivals(path.parent))


def key_used(path: Path) -> None:
    path.chmod(0o600)
    curve.secret_key(path)


def there(*paths: Path) -> Callable[[Path], list[bytes]]:
    return lambda _: [path.read_bytes() for path in paths]


TABLE = table_of(layouts.load(SkinConfig().layout), uid=True).encode()
READERS = {  # by the name of the file
    "any.toml": Reader(load, there(ROOT / "examples" / "can0.toml")),
    "scenario.toml": Reader(
        lambda path: scenario.load(str(path)), there(*scenario.shipped().values())
    ),
    "bundle.json": Reader(manifest_used, there(SHIPPED / "bundle.json")),
    "scene.npz": Reader(scene_used, there(SHIPPED / "scene.npz"), 30),
    "sampler.onnx": Reader(
        lambda path: Sampler(path.read_bytes(), loaded().model.layout, "density", path.parent),
        there(SHIPPED / "density-64.onnx"),
        30,
    ),
    "skin.csv": Reader(layout_used, lambda _: [TABLE]),
    "skin.json": Reader(layout_used, lambda _: [json.dumps(document(16)).encode()]),
    session.ARRIVALS: Reader(session_used, there(RECORDED / session.ARRIVALS)),
    session.TRUTH: Reader(
        lambda path: session.truth(path.parent), lambda _: [b"t,x,y,theta\n1.5,0.1,-0.2,3.0\n"]
    ),
    "key": Reader(
        key_used, lambda place: [Path(create_certificates(place, "made")[1]).read_bytes()]
    ),
}


def changed(whole: bytes, rng: random.Random) -> bytes:
    """A file with some bytes changed, cut out, put twice or put in, and perhaps cut short."""
    data = bytearray(whole)
    for _ in range(rng.randint(1, 4)):
        # headers, names and directories stand at the edges
        span = rng.choice([len(data), min(len(data), 300)])
        at = rng.randrange(span + 1)
        at = len(data) - at if rng.random() < 0.3 else at
        length = rng.choice([1, 4, 30, 300])
        match rng.randrange(6):
            case 0 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at : at + length] = rng.randbytes(length)
            case 2:
                del data[at : at + length]
            case 3:
                data[at:at] = data[at : at + length]
            case 4:
                data[at:at] = rng.choice(TOKENS)
            case 5:
                data[at : at + length] = rng.choice(TOKENS)
    return bytes(data[: rng.randrange(len(data) + 1)] if rng.random() < 0.1 else data)


@pytest.mark.parametrize("name", READERS)
def test_any_file_is_read_or_refused_with_one_line(name: str, tmp_path: Path) -> None:
    """A whole one, changed ones, and those of nothing but what breaks readers."""
    reader, rng, path = READERS[name], random.Random(name), tmp_path / "files" / name
    path.parent.mkdir()
    whole = reader.samples(tmp_path)
    for content in whole:
        path.write_bytes(content)
        reader.use(path)
    strange = [changed(rng.choice(whole), rng) for _ in range(reader.examples)]
    for content in (*strange, b"", *TOKENS, b"".join(TOKENS), bytes(range(256)) * 40):
        path.write_bytes(content)
        used_or_refused(lambda: reader.use(path))
