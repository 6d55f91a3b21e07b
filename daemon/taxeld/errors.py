"""The one exception that reaches a user: a fault in what was asked for or configured."""


class SetupError(Exception):
    """A configuration, bundle, layout or device that cannot be used.

    The message is one line that names what and where, and the cure; commands print it and
    exit 2. Data that arrive at run time never raise: they become counters and flags.
    """
