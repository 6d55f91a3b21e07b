"""The part of the estimator that is written in C, where a compiler is at hand; taxeld works without
it, and more slowly (daemon/taxeld/estimator/compiled.py)."""

import hashlib
import os
import shlex
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

SOURCE = Path("daemon/taxeld/estimator/explain.c")
FAST = ["-std=c11", "-O3", "-ffast-math", "-fPIC", "-Wall", "-Wextra"]


class CompiledHook(BuildHookInterface[Any]):
    """Of wheels and of editable installs."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
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
