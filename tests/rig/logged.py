"""The lines of a daemon's log, as a file has them."""

import re

LINE = re.compile(r"\d{4}-\d\d-\d\dT[\d:]+[+-]\d{4} (DEBUG|INFO|WARNING|ERROR) +(.*)")


def messages(text: str, *leave_out: str) -> list[str]:
    """Without their time and level, and without those of some levels; what was not logged but
    printed is kept."""
    found = []
    for line in text.splitlines():
        logged = LINE.fullmatch(line)
        if logged is None or logged[1] not in leave_out:
            found.append(line if logged is None else logged[2])
    return found


def warnings(text: str) -> list[str]:
    return messages(text, "DEBUG", "INFO")
