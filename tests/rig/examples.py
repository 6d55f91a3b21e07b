"""How many examples a property has that is dear, or cheap: `make check` tries more of each."""

from hypothesis import settings

USUAL = 100  # examples of a property, where nothing else is said


def examples(number: int) -> settings:
    """So many in `make test`."""
    return settings(max_examples=number * settings.default.max_examples // USUAL)
