"""The one exception that reaches a user: a fault in what was asked for or configured."""

MOST = 1000  # characters of a message


def one_line(text: str) -> str:
    """Text of any origin as a line that can be printed."""
    shown = "".join(c if c.isprintable() else "?" for c in text[:MOST])
    return shown + "…" if len(text) > MOST else shown


class SetupError(Exception):
    """A configuration, bundle, layout or device that cannot be used.

    The message is one line, whatever it quotes, that names what and where, and the cure; commands
    print it and exit 2. Data that arrive at run time never raise: they become counters and flags.
    """

    def __init__(self, message: str) -> None:
        super().__init__(one_line(message))
