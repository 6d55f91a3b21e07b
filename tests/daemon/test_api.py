"""The public face."""

import pytest

from taxeld import api


@pytest.mark.parametrize("name", api.__all__)
def test_every_public_name_is_there_and_says_what_it_is(name: str) -> None:
    found = getattr(api, name)
    assert found.__doc__
    assert not found.__doc__.startswith(f"{name}(")  # what a dataclass has without a docstring
