"""Particles and samples that were enough when a bundle was built hold unless the file says more."""

import json
import shutil
from pathlib import Path

import pytest

from taxeld.commands import check
from taxeld.config import file
from taxeld.config.tables import FilterConfig
from taxeld.errors import SetupError
from taxeld.proposals import bundle, manifest, several

ENOUGH = {"particles": 25, "particles_max": 90, "injected": 12}


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """The box, of which few particles are enough."""
    made = Path(shutil.copytree(bundle.find("box"), tmp_path / "small"))
    say(made, ENOUGH)
    return made


def say(made: Path, enough: object) -> None:
    path = made / manifest.NAME
    told = json.loads(path.read_text(encoding="utf-8")) | {"filter": enough}
    path.write_text(json.dumps(told), encoding="utf-8")


def sizes(names: list[str], text: str = "") -> tuple[int, int, int]:
    given = ", ".join(f'"{name}"' for name in names)
    config = file.parse(
        f'[scene]\nbundles = [{given}]\n[source]\nkind = "can"\nchannel = "a"\n[filter]\n{text}'
    )
    now = several.sized(config, [bundle.manifest_of(name) for name in names]).filter
    return now.particles, now.particles_max, now.injected


def test_what_was_enough_holds_unless_the_file_gives_any_of_these_keys(small: Path) -> None:
    usual = FilterConfig()
    assert sizes([str(small)]) == (25, 90, 12)
    assert sizes([str(small)], "nudge_m = 0.002") == (25, 90, 12)
    shipped = (usual.particles, usual.particles_max, usual.injected)
    assert sizes([str(small)], f"particles = {usual.particles}") == shipped
    assert sizes([str(small)], "injected = 20") == (usual.particles, usual.particles_max, 20)


def test_a_bundle_that_does_not_say_what_was_enough_changes_nothing() -> None:
    usual = FilterConfig()
    assert sizes(["box"]) == (usual.particles, usual.particles_max, usual.injected)


def test_of_several_objects_the_one_that_needs_most_counts(small: Path) -> None:
    assert sizes([str(small), "mug"]) == sizes(["mug"])


@pytest.mark.parametrize("is_given", [False, True])
def test_check_says_whose_numbers_hold(small: Path, is_given: bool) -> None:
    own = "particles = 60" if is_given else ""
    config = file.parse(
        f'[scene]\nbundle = "{small}"\n[source]\nkind = "can"\nchannel = "a"\n[filter]\n{own}'
    )
    (line,) = check.notes(config)
    assert line == (
        "filter: 60..400 particles, 50 samples, as this configuration says"
        if is_given
        else "filter: 25..90 particles, 12 samples, as was enough when the bundle was built"
    )


@pytest.mark.parametrize(
    ("enough", "fault"),
    [
        ([], "filter: must be a table, not []"),
        ({"particles": 1.5}, "filter.particles: must be an integer, not 1.5"),
        ({"particles": 1}, "filter.particles: must be 2..100000, not 1"),
        ({"injected": True}, "filter.injected: must be an integer, not True"),
        ({"particles_max": 10**30}, "filter.particles_max: must be an integer, not 1000"),
    ],
)
def test_numbers_that_no_filter_can_have_are_refused_in_one_line(
    small: Path, enough: object, fault: str
) -> None:
    say(small, enough)
    with pytest.raises(SetupError, match="build the bundle again") as refusal:
        bundle.manifest_of(str(small))
    assert fault in str(refusal.value)
