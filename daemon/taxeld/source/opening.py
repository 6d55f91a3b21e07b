"""Lines on why a device cannot be opened, with the cure."""

import errno
import os

from taxeld.errors import SetupError
from taxeld.source.device import AwayError, BusyError

ABSENT = "it is not there; is it plugged in?"
DENIED = "permission denied; is this user in the group that owns it?"
REASONS = {  # words in place of the system's own
    errno.ENOENT: ABSENT,
    errno.ENODEV: ABSENT,
    errno.ENXIO: ABSENT,
    errno.EACCES: DENIED,
    errno.EPERM: DENIED,
    errno.ENOTTY: "it is no serial line",
    errno.EISDIR: "it is a directory",
}
BUSY = {errno.EAGAIN, errno.EBUSY}
# faults that waiting does not cure
FOR_A_PERSON = {errno.EACCES, errno.EPERM, errno.ENOTTY, errno.EISDIR}


def unopened(where: str, error: Exception) -> SetupError:
    """The exception for `error` when opening a device at `where`."""
    number = _errno(error)
    if number in BUSY:
        return busy(where)
    reason = REASONS.get(number) or (os.strerror(number) if number else first_line(error))
    for_a_person = number in FOR_A_PERSON or (not number and isinstance(error, ValueError))
    kind = SetupError if for_a_person else AwayError
    return kind(f"source.channel: cannot open {where} ({reason})")


def busy(where: str) -> BusyError:
    """The exception for a device at `where` that another process has open."""
    return BusyError(
        f"source.channel: cannot open {where} (another process has it open; stop that first, "
        f"'fuser {where}' tells which)"
    )


def first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _errno(error: BaseException | None) -> int:
    """The system's number of the fault behind an exception; 0 where there is none."""
    while error is not None:
        number = getattr(error, "errno", None) or next(iter(error.args), None)
        if isinstance(number, int):
            return number
        error = error.__cause__ or error.__context__
    return 0
