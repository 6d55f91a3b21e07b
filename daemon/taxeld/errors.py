"""The one exception that reaches a user: a fault in what was asked for or configured."""

HEAD, TAIL = 700, 300  # characters of a message kept: its beginning, and its end with the cure


def one_line(text: str) -> str:
    """Text of any origin as a line that can be printed."""
    if len(text) > HEAD + TAIL:
        text = f"{text[:HEAD]} … {text[-TAIL:]}"
    return "".join(c if c.isprintable() else "?" for c in text)


class SetupError(Exception):
    """A configuration, bundle, layout or device that cannot be used.

    The message is one line, even where it quotes several, that names the fault, its place and the
    cure; commands print it and exit 2. Data that arrive at run time never raise: they become
    counters and flags.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))


class WorkError(SetupError):
    """Nothing is wrong with what was asked, and yet it failed: commands exit 1."""
