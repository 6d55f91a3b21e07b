"""Commands in the process of the test, and what is refused with one line."""

import contextlib
import io
from collections.abc import Callable, Sequence

import pytest

from taxeld import cli
from taxeld.errors import SetupError

Main = Callable[[Sequence[str]], int]


def _run(main: Main, arguments: Sequence[object]) -> tuple[int, str, str]:
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        status = main([str(argument) for argument in arguments])
    return status, out.getvalue(), errors.getvalue()


def refused(*arguments: object, status: int = 2, main: Main = cli.main) -> str:
    """The one line of a command that prints nothing else and ends with this status."""
    ended, printed, said = _run(main, arguments)
    assert (ended, printed, said.count("\n")) == (status, "", 1), said
    return said


def printed(*arguments: object, main: Main = cli.main) -> str:
    """The output of a command that succeeds and complains of nothing."""
    status, out, said = _run(main, arguments)
    assert (status, said) == (0, "")
    return out


def refuses(said: str, act: Callable[..., object], *given: object, **more: object) -> None:
    """What a caller asks for is refused with one line that a user can read; `said`: its pattern."""
    with pytest.raises(SetupError, match=said) as error:
        act(*given, **more)
    assert str(error.value).isprintable()
