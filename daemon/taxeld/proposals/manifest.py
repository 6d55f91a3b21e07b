"""`bundle.json`: what a bundle says of itself, checked before any of it is used."""

import json
import re
from pathlib import Path
from typing import Any, NoReturn

from taxeld.errors import SetupError
from taxeld.proposals.analytic import ANALYTIC

NAME = "bundle.json"
SCENE = "scene.npz"
FORMAT = 3  # 2 had no digests
KINDS = ("density", "ddpm")  # of samplers

MAX_BYTES = 1_000_000
MAX_SAMPLERS = 100
MAX_TEXT = 500  # characters
LARGEST = 1e18
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


def parse(text: bytes, path: Path) -> dict[str, Any]:
    """The content of `bundle.json`, which `path` names in messages.

    Raises:
        SetupError: it is damaged, or of another format.
    """
    try:
        return _parse(text)
    except (ValueError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else error
        raise SetupError(f"{path}: {reason}") from None


def _parse(text: bytes) -> dict[str, Any]:
    """Raises ValueError, with what is wrong."""
    if len(text) > MAX_BYTES:
        raise ValueError("is too large; build the bundle again")
    try:
        info = json.loads(text.decode("utf-8"), parse_constant=_no_number)
    except ValueError as error:
        raise ValueError(f"unreadable ({error}); build the bundle again") from None
    if not isinstance(info, dict):
        raise ValueError("is no map; build the bundle again")
    found = info.get("format")
    if found == FORMAT - 1:
        raise ValueError(
            f"is of bundle format {found}, without digests; build the bundle again, or run "
            "'taxeld-train seal' on its directory"
        )
    if found != FORMAT:
        raise ValueError(f"is not of bundle format {FORMAT}; build the bundle again")
    if not _is_text(info.get("object")):
        raise ValueError("object is missing or no line of text")
    if not (info.get("attribution", "") is None or _is_text(info.get("attribution"))):
        raise ValueError("attribution is missing or no line of text")
    mesh = info.get("mesh")  # a file of the bundle, where the object is none of YCB's
    if mesh is not None and not (isinstance(mesh, str) and _NAME.fullmatch(mesh)):
        raise ValueError("mesh is no name of a file")
    layout = info.get("layout")
    if not isinstance(layout, dict) or not all(_is_text(layout.get(k)) for k in ("name", "digest")):
        raise ValueError("layout needs a name and a digest")
    for key in ("height_m", "depth_max_m"):
        if not _is_number(info.get(key)):
            raise ValueError(f"{key} is missing or no number")
    _check_files(info.get("files"))
    _check_samplers(info.get("samplers"), info["files"])
    _check_auto(info.get("auto"), {sampler["name"] for sampler in info["samplers"]})
    return info


def _check_files(files: object) -> None:
    if not isinstance(files, dict) or SCENE not in files or len(files) > MAX_SAMPLERS + 1:
        raise ValueError(f"files needs the SHA-256 of {SCENE} and of each sampler")
    for name, digest in files.items():
        if not _is_name(name) or name == NAME:
            raise ValueError(f"files: {name!r:.70} is no file's name")
        if not isinstance(digest, str) or not _DIGEST.fullmatch(digest):
            raise ValueError(f"files.{name} is no SHA-256")


def _check_samplers(samplers: object, files: dict[str, str]) -> None:
    if not isinstance(samplers, list) or len(samplers) > MAX_SAMPLERS:
        raise ValueError("samplers is missing or no list")
    names = set(ANALYTIC)
    for i, sampler in enumerate(samplers):
        at = f"samplers[{i}]"
        if not isinstance(sampler, dict):
            raise ValueError(f"{at} needs name, kind, file and flops")
        if not _is_name(sampler.get("name")) or sampler["name"] in names:
            raise ValueError(f"{at}.name is missing, no plain name, or taken")
        names.add(sampler["name"])
        if sampler.get("kind") not in KINDS:
            raise ValueError(f"{at}.kind is none of {', '.join(KINDS)}")
        if not _is_name(sampler.get("file")) or sampler["file"] not in files:
            raise ValueError(f"{at}.file is missing or has no SHA-256 in files")
        if not _is_number(sampler.get("flops")) or sampler["flops"] <= 0:
            raise ValueError(f"{at}.flops is missing or no positive number")


def _check_auto(auto: object, samplers: set[str]) -> None:
    if not isinstance(auto, list):
        raise ValueError("auto is missing or no list")
    known = samplers.union(ANALYTIC)
    for i, name in enumerate(auto):
        if not isinstance(name, str) or name not in known or name in auto[:i]:
            raise ValueError(f"auto: no such proposal or sampler, or twice: {name!r:.70}")


def _no_number(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number")


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and abs(value) < LARGEST  # type: ignore[arg-type]


def _is_text(value: object) -> bool:
    """Whether it is a short line that can be printed."""
    return isinstance(value, str) and value.isprintable() and len(value) <= MAX_TEXT


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None
