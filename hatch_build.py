"""What a build adds to the Python code: the part of the estimator that is written in C, and manual
pages with shell completions.

Without a C compiler taxeld works, and more slowly (daemon/taxeld/estimator/compiled.py).
"""

import hashlib
import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = Path("daemon/taxeld/estimator/explain.c")
FAST = ["-std=c11", "-O3", "-ffast-math", "-fPIC", "-Wall", "-Wextra"]


class CompiledHook(BuildHookInterface[Any]):
    """Compiles for wheels and editable installs; a wheel holds pages and completions as well."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        self._pages = tempfile.TemporaryDirectory()
        if version != "editable":
            self._write_pages(build_data)
        self._compile(build_data)

    def finalize(self, *_: object) -> None:
        self._pages.cleanup()

    def _write_pages(self, build_data: dict[str, Any]) -> None:
        sys.path[:0] = [
            self.root,
            *(str(Path(self.root, one)) for one in self.build_config.dev_mode_dirs),
        ]
        from deploy import manuals  # noqa: PLC0415  (of this tree)

        for number, (name, text) in enumerate(manuals.files().items()):
            path = Path(self._pages.name, str(number))
            path.write_text(text, encoding="utf-8")
            build_data["shared_data"][str(path)] = name

    def _compile(self, build_data: dict[str, Any]) -> None:
        source = Path(self.root, SOURCE)
        library = source.with_suffix(".so")
        compiler = shlex.split(os.environ.get("CC", "cc"))
        if shutil.which(compiler[0]) is None:
            library.unlink(missing_ok=True)
            self.app.display_warning(f"no C compiler ({compiler[0]}): numpy does all the work")
            return
        digest = hashlib.sha256(source.read_bytes()).hexdigest()
        part = library.with_suffix(f".{os.getpid()}.o")
        made = library.with_suffix(f".{os.getpid()}.so")
        named = f'-DSOURCE="{digest}"'
        try:
            # linked without -ffast-math, which would change the processor's mode for all of Python
            subprocess.run([*compiler, *FAST, named, "-c", source, "-o", part], check=True)  # noqa: S603
            subprocess.run([*compiler, "-shared", part, "-o", made, "-lm"], check=True)  # noqa: S603
            made.replace(library)
        except subprocess.CalledProcessError:
            library.unlink(missing_ok=True)
            self.app.display_warning(f"{SOURCE} does not compile: numpy does all the work")
            return
        finally:
            part.unlink(missing_ok=True)
            made.unlink(missing_ok=True)
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        build_data["pure_python"] = False
        build_data["artifacts"].append(f"/{SOURCE.with_suffix('.so')}")
