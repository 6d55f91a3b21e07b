"""Messages of arrays: any input is a frame or a reason, and a decoder takes each frame or counts
why not."""

import json
import math
from typing import Any

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld_protocol import array
from taxeld_protocol.array import FULL, REST, ArrayDecoder, ArrayFrame

GOOD = {"t": 1.5, "id": "arm", "z": [0.0, 0.25, 1.0]}
UIDS = [17, 18, 33]
FRAME = ArrayFrame(1.5, "arm", 0, (10, 20, 30))

keys = st.sampled_from(["t", "id", "z", "counts", "valid", "x"])
plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3)
anything = st.recursive(plain, lambda inner: st.lists(inner) | st.dictionaries(keys, inner))


def test_activations_become_counts_over_a_known_rest() -> None:
    frame = array.parse(GOOD)
    assert frame == ArrayFrame(1.5, "arm", REST, (REST, REST + FULL // 4, REST + FULL))
    assert array.parse({"t": 1, "id": 7, "counts": [1, 2.6]}) == ArrayFrame(1.0, "7", 0, (1, 3))


def test_a_value_that_is_null_or_marked_invalid_is_no_reading() -> None:
    marked = array.parse({**GOOD, "valid": [True, False, True]})
    assert marked == array.parse({**GOOD, "z": [0.0, None, 1.0]})
    assert marked.counts[1] == 0
    nan = {**GOOD, "z": [0.0, math.nan, 1.0]}
    assert isinstance(array.parse({**nan, "valid": [True, False, True]}), ArrayFrame)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": "now"}, "t is no Unix time"),
        ({"t": math.nan}, "t is no Unix time"),
        ({"t": 10**400}, "t is no Unix time"),
        ({"t": 1.7e12}, "t is no Unix time"),
        ({"id": None}, "id is no number and no text"),
        ({"id": "a" * 61}, "id is no number and no text"),
        ({"id": "a\n"}, "id is no number and no text"),
        ({"counts": [1]}, "it must have z (activations 0 to 1) or counts"),
        ({"z": {}}, "z is no list of 1 to 5000 values"),
        ({"z": []}, "z is no list of 1 to 5000 values"),
        ({"z": [0.0] * 5001}, "z is no list of 1 to 5000 values"),
        ({"z": [True, 0.0]}, "z has values that are no numbers"),
        ({"z": [0.0, math.nan]}, "z has values that are not finite"),
        ({"z": [math.nan, 0.0]}, "z has values that are not from -0.04 to 2"),
        ({"z": [0.0, math.inf]}, "z has values that are not from -0.04 to 2"),
        ({"z": [0.0, 10**400]}, "z has values that are not from -0.04 to 2"),
        ({"z": [0.0, 300.0]}, "z has values that are not from -0.04 to 2"),
        ({"valid": [True]}, "valid is no list of as many booleans"),
        ({"valid": [1, 1, 1]}, "valid has values that are no booleans"),
    ],
)
def test_a_message_that_is_no_array_is_told_why(change: dict[str, Any], words: str) -> None:
    assert str(array.parse(GOOD | change)).startswith(words)


@given(anything | st.fixed_dictionaries({}, optional=dict.fromkeys(GOOD, anything)))
def test_any_value_is_a_frame_or_a_reason(value: Any) -> None:
    found = array.parse(value)
    if isinstance(found, str):
        assert found.isprintable()
        return
    assert math.isfinite(found.t)
    assert all(0 <= count <= array.COUNT_MAX for count in found.counts)
    again = array.parse(array.read_json(array.line_of(found)))
    assert again == found, "a recording holds it as it is"


BOMBS = [b"[" * 200_000, b'{"t":' * 50_000, b'{"t":' + b"9" * 100_000 + b"}", b'{"z":[1e999]}']


@given(st.sampled_from(BOMBS) | st.binary() | st.text().map(str.encode))
def test_any_bytes_are_an_array_or_a_reason(body: bytes) -> None:
    assert body not in BOMBS or isinstance(array.parse(array.read_json(body)), str)
    array.parse(array.read_json(body))


def taken(decoder: ArrayDecoder, *frames: ArrayFrame) -> list[float]:
    """The times of the scans."""
    return [scan.t for frame in frames for scan in decoder.feed(frame)[1]]


def test_what_cannot_be_used_is_counted_and_nothing_is_lost_of_the_others() -> None:
    decoder = ArrayDecoder(UIDS, "arm")
    at = [FRAME._replace(t=float(t)) for t in range(5)]
    strange = [
        FRAME._replace(t=1.5, id="leg"),
        FRAME._replace(t=1.6, counts=(1, 2)),
        FRAME._replace(t=1.7, rest=REST),
        FRAME._replace(t=0.5),
    ]
    assert taken(decoder, *at[:2], *strange, *at[2:]) == [0.0, 1.0, 2.0, 3.0, 4.0]
    stats = decoder.stats()
    assert stats["dropped"] == dict.fromkeys(("length_errors", "foreign", "disordered", "mixed"), 1)
    assert (stats["frames"], stats["used"]) == (9, 5)


def test_two_senders_whose_times_jump_back_and_forth_give_one_ordered_stream() -> None:
    decoder = ArrayDecoder(UIDS)
    early = [FRAME._replace(t=float(t)) for t in range(100)]
    late = [FRAME._replace(t=100.0 + t) for t in range(100)]
    both = [frame for pair in zip(late, early, strict=True) for frame in pair]
    assert taken(decoder, *both) == [frame.t for frame in late]
    assert decoder.counters.disordered == 100
    assert "do two programs send it" in "".join(
        decoder.fault for frame in both if decoder.feed(frame)[1] == []
    )


def test_a_clock_that_was_set_back_costs_ten_frames() -> None:
    decoder = ArrayDecoder(UIDS)
    taken(decoder, FRAME._replace(t=1000.0))
    assert len(taken(decoder, *(FRAME._replace(t=float(t)) for t in range(20)))) == 11


def test_a_frame_from_the_future_keeps_out_no_other() -> None:
    decoder = ArrayDecoder(UIDS)
    decoder.now_t = 10.0
    assert taken(decoder, FRAME, FRAME._replace(t=1e9), FRAME._replace(t=2.0)) == [1.5, 1e9, 2.0]


def test_the_first_id_is_heard_where_none_is_named() -> None:
    decoder = ArrayDecoder(UIDS)
    frames = [FRAME._replace(t=float(t), id="ab"[t % 2]) for t in range(4)]
    assert taken(decoder, *frames) == [0.0, 2.0]


@given(anything)
def test_msgpack_and_json_take_the_same_keys(value: Any) -> None:
    message = {"t": 1.0, "id": "a", "z": value}
    try:
        packed, text = msgpack.packb(message), json.dumps(message)
    except (OverflowError, ValueError, TypeError):
        return
    assert repr(array.parse(msgpack.unpackb(packed))) == repr(array.parse(json.loads(text)))
