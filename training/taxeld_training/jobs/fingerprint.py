"""Hashes of what decides a job's result, the code and the bundles that ship, for its key."""

import hashlib
from functools import cache
from importlib import resources
from pathlib import Path

BUNDLES = Path(str(resources.files("taxeld") / "bundles"))


@cache
def of(*names: str) -> str:
    """Hash of the source of rooms, and of modules by their full names."""
    digest = hashlib.sha256()
    for name in names:
        package, _, last = name.rpartition(".")
        room = Path(str(resources.files(package))) / last
        files = sorted(room.glob("*.py")) if room.is_dir() else [room.with_suffix(".py")]
        for file in files:
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


@cache
def of_bundles() -> str:
    """Hash of the shipped bundles: each bundle.json names the SHA-256 of all files beside it."""
    digest = hashlib.sha256()
    for file in sorted(BUNDLES.glob("*/bundle.json")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]
