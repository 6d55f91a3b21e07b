"""What this version no longer has, each with what replaces it.

A configuration's key (`table.key`), a command (`taxeld-hil draw`) or an option (`--truth`) that
stands here is refused with its line. The table is emptied at the next minor version.
"""

GONE: dict[str, str] = {
    "advice": "taxeld advise CONFIG asks the daemon what it has felt, and advises; see its options",
    "taxeld-hil calibration": "taxeld calibrate SESSION --check judges a skin's own touches",
    "scene.max_objects": "one object is estimated; a second one shows as `other` or `moved`",
    "--histogram": "lat_us of 'taxeld status' and /taxeld/health has median, 99 % and the longest",
}


def why(name: str) -> str | None:
    """One line about a key, command or option that is gone; None where it never was."""
    return f"{name}: is gone; {GONE[name]}" if name in GONE else None
