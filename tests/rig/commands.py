"""Commands in the process of the test."""

import contextlib
import io
from collections.abc import Callable, Sequence

from taxeld import cli

Main = Callable[[Sequence[str]], int]


def _run(main: Main, arguments: Sequence[object]) -> tuple[int, str, str]:
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        status = main([str(argument) for argument in arguments])
    return status, out.getvalue(), errors.getvalue()


def refused(*arguments: object, main: Main = cli.main) -> str:
    """The one line of a command that prints nothing else and ends with status 2."""
    status, printed, said = _run(main, arguments)
    assert (status, printed, said.count("\n")) == (2, "", 1), said
    return said


def printed(*arguments: object, main: Main = cli.main) -> str:
    """The output of a command that succeeds and complains of nothing."""
    status, out, said = _run(main, arguments)
    assert (status, said) == (0, "")
    return out
