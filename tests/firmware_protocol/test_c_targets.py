"""The C side on other processors: big-endian, 32 bits, and a microcontroller's compiler.

Cross compilers and qemu-user are Debian packages, which `.ci/run` installs; without them the tests
are skipped.
"""

import os
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.rig.conversations import load

from .c_side import STRICT, C
from .test_c_side import text_of_vectors
from .test_conversations import CYSKIN, text_of

ROUNDS_OF_DAMAGE = 2_000
TARGETS = {  # compiler and emulator
    "32 bits": ("arm-linux-gnueabihf-gcc", "qemu-arm"),
    "big-endian": ("s390x-linux-gnu-gcc", "qemu-s390x"),
}
COMPILERS = [
    *shlex.split(os.environ.get("CC", "cc"))[:1],
    *(compiler for compiler, _ in TARGETS.values()),
    "arm-none-eabi-gcc",  # of microcontrollers
]
CORE = {"arm-none-eabi-gcc": ["-mthumb", "-mcpu=cortex-m0"]}  # which cannot divide
STRING_H = """
#include <stddef.h>
void *memcpy(void *, const void *, size_t);
void *memset(void *, int, size_t);
"""  # all that the header takes of libc, so that none is needed to compile it
OBJECT = ["-ffreestanding", "-fno-pie", "-fno-stack-protector", "-U_FORTIFY_SOURCE", "-c"]


def needed(*programs: str) -> None:
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")


def run(*command: str | Path) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(params=TARGETS.values(), ids=TARGETS.keys())
def target(request: pytest.FixtureRequest) -> tuple[str, str]:
    needed(*request.param)
    compiler, emulator = request.param
    return compiler, emulator


def test_the_vectors_and_damage_pass_on_other_processors(
    target: tuple[str, str], tmp_path: Path
) -> None:
    compiler, emulator = target
    text = text_of_vectors()
    (tmp_path / "vectors.txt").write_text(text, encoding="utf-8")
    run(compiler, *STRICT, "-O2", "-static", C / "vectors_main.c", "-o", tmp_path / "vectors_main")
    printed = run(
        emulator, tmp_path / "vectors_main", tmp_path / "vectors.txt", str(ROUNDS_OF_DAMAGE)
    )
    assert printed == f"{text.count(chr(10))} vectors\n"


def test_the_conversations_are_held_on_other_processors(
    target: tuple[str, str], tmp_path: Path
) -> None:
    compiler, emulator = target
    run(compiler, *STRICT, "-O2", "-static", C / "hub_main.c", "-o", tmp_path / "hub_main")
    for name in CYSKIN:
        text = text_of(load(name))
        (tmp_path / name).write_text(text, encoding="ascii")
        printed = run(emulator, tmp_path / "hub_main", tmp_path / name)
        assert printed == f"{text.count(chr(10))} lines\n"


@pytest.mark.parametrize("level", ["-O0", "-Os", "-O2", "-O3"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_library_needs_nothing_of_libc_but_memcpy_and_memset(
    compiler: str, level: str, tmp_path: Path
) -> None:
    """Nor of the compiler's own library, as for a division."""
    needed(compiler)
    (tmp_path / "string.h").write_text(STRING_H, encoding="ascii")
    options = [*STRICT, level, *OBJECT, f"-I{tmp_path}", *CORE.get(compiler, [])]
    run(compiler, *options, C / "test_driver.c", "-o", tmp_path / "driver.o")
    undefined = run("nm", "--undefined-only", "--format=posix", tmp_path / "driver.o")
    assert {line.split()[0] for line in undefined.splitlines()} <= {"memcpy", "memset"}
