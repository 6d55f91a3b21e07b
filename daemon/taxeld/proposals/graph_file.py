"""A sampler's file, read as far as it says what it is: what goes in, and the skin it was made for.

ONNX is protobuf, and opening a large graph takes half a second; this takes milliseconds, and finds
a file that is no graph, or another one's.
"""

import json
from collections.abc import Iterator

from taxeld.layout.layout import Layout

MOST_STEPS = 10_000  # of noise
GRAPH, METADATA = 7, 14  # fields of a model
INPUT = 11  # … of a graph
NAME, TYPE = 1, 2  # … of an input
TENSOR, SHAPE, DIMENSION, SIZE = 1, 2, 1, 1  # … and on the way to a number of its shape
KEY, VALUE = 1, 2  # … of metadata
VARINT, FIXED_64, BYTES, FIXED_32 = 0, 1, 2, 5  # how a value is written
FIXED = {FIXED_64: 8, FIXED_32: 4}  # bytes

Shape = list[int | None]  # None: any


def noise_steps(content: bytes, layout: Layout) -> int:
    """The steps of noise of a graph (z, live, noise) → poses, which is for this skin.

    Raises:
        ValueError: it is none, with the reason.
    """
    # weights in other files are named by this key; onnxruntime up to 1.24 reads any file so
    if b"location" in content:
        raise ValueError("it names other files as its weights")
    inputs: dict[str, Shape] = {}
    for field, value in _parts(memoryview(content)):
        if field == GRAPH:
            inputs |= dict(_input(part) for number, part in _parts(value) if number == INPUT)
        elif field == METADATA:
            _check_layout(dict(_parts(value)), layout)
    if inputs.keys() != {"z", "live", "noise"}:
        raise ValueError("its inputs are not z, live and noise")
    taxels = len(layout)
    if inputs["z"] != [1, taxels] or inputs["live"] != [1, taxels]:
        raise ValueError(f"it is not for a skin of {taxels} taxels")
    match inputs["noise"]:
        case [int(steps), None, 4] if 0 < steps <= MOST_STEPS:
            return steps
    raise ValueError("its noise is not (steps, any number of samples, 4)")


def _check_layout(entry: dict[int, memoryview], layout: Layout) -> None:
    if bytes(entry.get(KEY, b"")) != b"layout":
        return
    theirs = json.loads(bytes(entry.get(VALUE, b"")))
    if theirs != layout.digest:
        raise ValueError(f"it is for the layout {theirs}, not for {layout.name} ({layout.digest})")


def _input(content: memoryview) -> tuple[str, Shape]:
    fields = dict(_parts(content))
    shape: Shape = []
    for field, value in _parts(_at(fields.get(TYPE), TENSOR)):
        if field == SHAPE:
            shape = [_size(part) for number, part in _parts(value) if number == DIMENSION]
    return bytes(fields.get(NAME, b"")).decode(), shape


def _at(content: memoryview | None, field: int) -> memoryview:
    """A part of a part; an empty one where there is none."""
    parts = dict(_parts(content)) if content is not None else {}
    return parts.get(field, memoryview(b""))


def _size(dimension: memoryview) -> int | None:
    return next((n for number, n in _numbers(dimension) if number == SIZE), None)


def _parts(content: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The fields of a message that hold bytes: texts and messages."""
    for field, value in _fields(content):
        if isinstance(value, memoryview):
            yield field, value


def _numbers(content: memoryview) -> Iterator[tuple[int, int]]:
    for field, value in _fields(content):
        if isinstance(value, int):
            yield field, value


def _fields(content: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """The fields of a message, to its last byte; raises ValueError where it is none."""
    at = 0
    while at < len(content):
        tag, at = _varint(content, at)
        kind = tag & 7
        if kind == VARINT:
            value, at = _varint(content, at)
            yield tag >> 3, value
            continue
        if kind == BYTES:
            size, at = _varint(content, at)
        elif kind in FIXED:
            size = FIXED[kind]
        else:
            raise ValueError("it is no graph")
        if size > len(content) - at:
            raise ValueError("it is cut short")
        if kind == BYTES:
            yield tag >> 3, content[at : at + size]
        at += size


def _varint(content: memoryview, at: int) -> tuple[int, int]:
    """→ the number, and where it ends."""
    if at < len(content) and content[at] < 128:  # as mostly
        return content[at], at + 1
    number = shift = 0
    for end in range(at, min(at + 10, len(content))):
        number |= (content[end] & 127) << shift
        if content[end] < 128:
            return number, end + 1
        shift += 7
    raise ValueError("it is cut short")
