"""`make lock`: the runtime's dependencies with the hashes of their wheels, as pip takes them.

pip resolves what pyproject.toml asks for, at the versions of constraints.txt, for each Python and
processor that the service runs on, and says which wheels it would install; none is downloaded.
"""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PROCESSORS = ("x86_64", "aarch64")
MANYLINUX = ("2_28", "2_27", "2_17", "2014")
HEADER = """\
# What the service runs on, for Python {pythons} on {processors}. Made by `make lock`
"""


def wheels(dependencies: list[str], python: str, processor: str) -> list[dict[str, Any]]:
    """What pip would install, as its installation report says."""
    platforms = [f"--platform=manylinux{'_' * ('_' in m)}{m}_{processor}" for m in MANYLINUX]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--dry-run",
            "--ignore-installed",
            "--target=.",
            "--report=-",
            "--only-binary=:all:",
            f"--python-version={python}",
            "--implementation=cp",
            *platforms,
            "-c",
            str(ROOT / "constraints.txt"),
            *dependencies,
        ],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found: list[dict[str, Any]] = json.loads(done.stdout)["install"]
    return found


def main() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    hashes: dict[str, set[str]] = {}
    for python in PYTHONS:
        for processor in PROCESSORS:
            for wheel in wheels(project["dependencies"], python, processor):
                name = f"{wheel['metadata']['name']}=={wheel['metadata']['version']}"
                sha256 = wheel["download_info"]["archive_info"]["hashes"]["sha256"]
                hashes.setdefault(name, set()).add(sha256)
    print(HEADER.format(pythons=", ".join(PYTHONS), processors=" and ".join(PROCESSORS)), end="")
    for name in sorted(hashes, key=str.lower):
        lines = [name, *(f"    --hash=sha256:{value}" for value in sorted(hashes[name]))]
        print(" \\\n".join(lines))


if __name__ == "__main__":
    main()
