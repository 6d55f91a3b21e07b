"""What the C header takes of a Cortex-M: bytes of flash by part, and of RAM by state.

    python benchmarks/header_size.py

Asks arm-none-eabi-gcc (Debian: gcc-arm-none-eabi), at -Os; a linker drops the parts that a firmware
does not call.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HEADER = Path(__file__).parents[1] / "firmware_protocol" / "c"
COMPILER, NAMES = "arm-none-eabi-gcc", "arm-none-eabi-nm"
CORES = ("cortex-m0", "cortex-m4")
PARTS = {  # by what the names of their functions begin with
    "packets and scans out": (
        "taxeld_crc8", "taxeld__put_u16", "taxeld__seal", "taxeld_packet_encode", "taxeld_declare",
        "taxeld_details", "taxeld__settle", "taxeld_scan", "taxeld_fragmenter",
    ),
    "requests in, CAN": ("taxeld_packet_parse", "taxeld_reassembler", "taxeld__close"),
    "serial line, both ways": (
        "taxeld_crc16", "taxeld_cobs", "taxeld__cobs", "taxeld_serial", "taxeld__line",
        "taxeld_receiver",
    ),
}  # fmt: skip
STATES = ("taxeld_reassembler", "taxeld_receiver", "taxeld_scan", "taxeld_fragmenter")
SOURCE = """
#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"
"""
# all that the header takes of libc, so that none is needed to compile it
STRING_H = """
#include <stddef.h>
void *memcpy(void *, const void *, size_t);
void *memset(void *, int, size_t);
"""


def main() -> int:
    if not is_here():
        print(f"no {COMPILER}: apt-get install gcc-arm-none-eabi", file=sys.stderr)
        return 1
    print("\n".join(table()))
    return 0


def is_here() -> bool:
    return shutil.which(COMPILER) is not None


def version() -> str:
    """Of the compiler."""
    return _run(COMPILER, "-dumpfullversion").strip()


def table() -> list[str]:
    """The rows of a Markdown table."""
    sizes = [symbols(core) for core in CORES]
    columns = [" | ".join(("bytes", *CORES)), "|".join(("---", *("---" for _ in CORES)))]
    rows = [f"| {columns[0]} |", f"|{columns[1]}|"]
    for part, starts in {**PARTS, "flash, in all": ("taxeld_",)}.items():
        told = (sum(n for s, n in of.items() if s.startswith(starts)) for of in sizes)
        rows.append(f"| {part} | {' | '.join(map(str, told))} |")
    for state in STATES:
        told = (of[f"ram_{state}"] for of in sizes)
        rows.append(f"| RAM of a `{state}` | {' | '.join(map(str, told))} |")
    return rows


def symbols(core: str) -> dict[str, int]:
    """Each function's bytes of flash, constants included, and each state's of RAM as `ram_…`."""
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "string.h").write_text(STRING_H, encoding="ascii")
        states = "".join(f"char ram_{state}[sizeof({state})];\n" for state in STATES)
        (place / "size.c").write_text(SOURCE + states, encoding="ascii")
        _run(
            COMPILER, "-std=c99", "-Os", "-ffreestanding", "-mthumb", f"-mcpu={core}",
            f"-I{place}", f"-I{HEADER}", "-c", str(place / "size.c"), "-o", str(place / "size.o"),
        )  # fmt: skip
        lines = _run(NAMES, "--print-size", "--defined-only", str(place / "size.o")).splitlines()
    found = [line.split() for line in lines]
    return {name: int(size, 16) for _, size, _, name in (f for f in found if len(f) == 4)}


def _run(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


if __name__ == "__main__":
    raise SystemExit(main())
