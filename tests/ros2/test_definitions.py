"""The types of the bridge are those of ROS 2's releases, as rosbags has their definitions."""

import dataclasses
import random
import typing
from itertools import dropwhile
from typing import Any

import pytest

pytest.importorskip("cyclonedds")
pytest.importorskip("rosbags")

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore

from taxeld_ros2 import dds
from taxeld_ros2 import ros_types as ros

RELEASES = [*dropwhile(lambda store: store is not Stores.ROS2_HUMBLE, Stores)]
BEFORE = Stores.ROS2_FOXY  # whose markers have fewer fields
KINDS = [
    kind
    for kind in vars(ros).values()
    if isinstance(kind, type) and issubclass(kind, ros.IdlStruct) and kind is not ros.IdlStruct
]
VALUES = {bool: True, int: 7, float: 1.5, str: "abc"}


def filled(kind: Any, rng: random.Random) -> Any:
    """A message of which no field, nor any sequence, is empty."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = typing.get_type_hints(kind, include_extras=True)
        names = [field.name for field in dataclasses.fields(kind)]
        return kind(*(filled(hints[name], rng) for name in names))
    (base, *how) = typing.get_args(kind) or (kind,)
    if how and hasattr(how[0], "subtype"):
        length = getattr(how[0], "length", None) or rng.randint(1, 3)
        return [filled(how[0].subtype, rng) for _ in range(length)]
    return VALUES[base]


@pytest.mark.parametrize("kind", KINDS, ids=dds.ros_type)
@pytest.mark.parametrize("release", RELEASES, ids=lambda release: release.name.lower())
def test_each_type_has_the_fields_of_ros_in_their_order(release: Any, kind: Any) -> None:
    written = filled(kind, random.Random(0)).serialize(use_version_2=False)
    store, name = get_typestore(release), dds.ros_type(kind)
    read = store.deserialize_cdr(written, name)
    assert bytes(store.serialize_cdr(read, name)) == written


def test_markers_before_humble_are_another_type() -> None:
    written = filled(ros.Marker, random.Random(0)).serialize(use_version_2=False)
    store, name = get_typestore(BEFORE), dds.ros_type(ros.Marker)
    assert "texture" not in store.types[name].__dataclass_fields__
    with pytest.raises(SerdeError):
        store.deserialize_cdr(written, name)
