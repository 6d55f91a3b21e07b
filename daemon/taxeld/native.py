"""Code in C beside its numpy twin: finds the libraries built when taxeld was installed
(hatch_build.py).

A room stays pure with it, as with numpy, because only the installation decides. With
TAXELD_COMPILED=0 in the environment no library is found, and numpy does the work.
"""

import ctypes
import functools
import hashlib
import os
from pathlib import Path

HERE = Path(__file__).parent
SWITCH = "TAXELD_COMPILED"


@functools.cache
def library(name: str) -> ctypes.CDLL | None:
    """The library of the C file `name` (`estimator/explain`); None where none was built from this
    very code for this processor."""
    made = (HERE / name).with_suffix(".so")
    if os.environ.get(SWITCH) == "0" or not made.exists():
        return None
    try:
        found = ctypes.CDLL(str(made))
        source = (ctypes.c_char * 64).in_dll(found, "taxeld_source").value.decode()
    except (OSError, ValueError):
        return None
    code = made.with_suffix(".c").read_bytes()
    return found if source == hashlib.sha256(code).hexdigest() else None
