"""The C side on other processors, big-endian, of 32 bits and small, and in others' builds.

Cross compilers, qemu-user and cmake are Debian packages, which `.ci/run` installs; without them the
tests are skipped.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from taxeld import __version__
from tests.rig.conversations import NAMES, load

from .c_side import STRICT, C
from .test_c_side import text_of_vectors
from .test_conversations import text_of

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
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(params=TARGETS.values(), ids=TARGETS.keys())
def target(request: pytest.FixtureRequest) -> tuple[str, str]:
    needed(*request.param)
    compiler, emulator = request.param
    return compiler, emulator


def test_vectors_damage_and_conversations_are_the_same_on_other_processors(
    target: tuple[str, str], tmp_path: Path
) -> None:
    compiler, emulator = target
    texts = {name: text_of(load(name)) for name in NAMES}
    for program, scripts, more, unit in (
        ("vectors_main", {"vectors": text_of_vectors()}, [str(ROUNDS_OF_DAMAGE)], "vectors"),
        ("hub_main", texts, [], "lines"),
    ):
        run(compiler, *STRICT, "-O2", "-static", C / f"{program}.c", "-o", tmp_path / program)
        for name, text in scripts.items():
            (tmp_path / name).write_text(text, encoding="utf-8")
            printed = run(emulator, tmp_path / program, tmp_path / name, *more)
            assert printed == f"{text.count(chr(10))} {unit}\n"


@pytest.mark.parametrize("level", ["-O0", "-Os", "-O3"])
@pytest.mark.parametrize(
    "compiler", [COMPILERS[0], *(pytest.param(c, marks=pytest.mark.check) for c in COMPILERS[1:])]
)
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


def test_the_pages_program_is_also_a_program_in_cpp(tmp_path: Path) -> None:
    """As PlatformIO's frameworks compile a sketch."""
    needed("c++")
    strict = ["-x", "c++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    run("c++", *strict, "-c", C / "own_skin.c", "-o", tmp_path / "own_skin.o")


@pytest.mark.parametrize(
    "found_by",
    [f"find_package(taxeld_protocol {__version__} REQUIRED)", "add_subdirectory({C} taxeld)"],
)
def test_a_cmake_project_uses_the_header(tmp_path: Path, found_by: str) -> None:
    needed("cmake", COMPILERS[0])
    made, prefix = tmp_path / "made", tmp_path / "prefix"
    run("cmake", "-S", C, "-B", tmp_path / "library", f"-DCMAKE_INSTALL_PREFIX={prefix}")
    run("cmake", "--install", tmp_path / "library")
    (tmp_path / "CMakeLists.txt").write_text(
        f"""
        cmake_minimum_required(VERSION 3.14)
        project(firmware LANGUAGES C)
        {found_by.format(C=C)}
        add_executable(firmware main.c)
        target_link_libraries(firmware taxeld_protocol::taxeld_protocol)
        """,
        encoding="utf-8",
    )
    (tmp_path / "main.c").write_text(
        """
        #include <stdio.h>
        #define TAXELD_PROTOCOL_IMPLEMENTATION
        #include <taxeld_protocol.h>
        int main(void) { return printf("%02X", taxeld_crc8((const uint8_t *)"123456789", 9)) != 2; }
        """,
        encoding="utf-8",
    )
    run("cmake", "-S", tmp_path, "-B", made, f"-DCMAKE_PREFIX_PATH={prefix}")
    run("cmake", "--build", made)
    assert run(made / "firmware") == "FB"


def test_the_manifests_have_the_version_and_files_that_are_there() -> None:
    """Of the header, of CMake, and of PlatformIO: its required fields and those that name files."""
    header = (C / "taxeld_protocol.h").read_text(encoding="utf-8")
    parts = re.findall(r"#define TAXELD_PROTOCOL_VERSION_[A-Z]+ (\d+)", header)
    number = int("".join(f"{int(part):02d}" for part in parts))
    assert (".".join(parts), f"VERSION {number}L " in header.replace("\n", " ")) == (
        __version__,
        True,
    )
    project = (C / "CMakeLists.txt").read_text(encoding="utf-8")
    assert re.findall(r"project\(.* VERSION (\S+)", project) == [__version__]
    library = json.loads((C / "library.json").read_text(encoding="utf-8"))
    assert (library["name"], library["version"]) == ("taxeld_protocol", __version__)
    assert {"description", "keywords", "license"} <= library.keys()
    [example] = library["examples"]
    files = {library["headers"], *example["files"], *library["export"]["include"]}
    assert all((C / file).is_file() for file in files)
