"""ZMTP: what ZeroMQ says is understood, whatever comes is bounded, and strangers are told apart."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.stream import zmtp
from taxeld.stream.zmtp import COMMAND, GREETING, LONG, MORE, Conversation

KINDS = frozenset((b"REQ", b"DEALER"))
LARGEST, FRAMES = 300, 3
# what libzmq 4.3.5 sends: its greeting of ZMTP 3.1, READY, and a request or a subscription
GREETED = bytes.fromhex("ff00000000000000017f03014e554c4c") + bytes(48)
REQ = GREETED + bytes.fromhex(
    "04260552454144590b536f636b65742d5479706500000003524551084964656e746974790000000001000003616263"
)
SUB = GREETED + bytes.fromhex(
    "04190552454144590b536f636b65742d54797065000000035355420009012f746178656c642f"
)


def conversation(*said: bytes, kinds: frozenset[bytes] = KINDS) -> Conversation:
    made = Conversation(kinds, LARGEST, FRAMES)
    for part in said:
        made.take(part)
    return made


def begun() -> Conversation:
    """One whose peer has said who it is."""
    made = conversation(zmtp.hello(b"REQ"))
    assert made.next() == []
    assert made.is_ready
    return made


def heard(made: Conversation) -> list[list[bytes]]:
    found = []
    while (message := made.next()) is not None:
        found += [message] if message else []
    return found


def test_what_zeromq_sends_is_understood() -> None:
    assert heard(conversation(REQ)) == [[b"", b"abc"]]
    assert heard(conversation(SUB, kinds=frozenset([b"SUB"]))) == [[b"\x01/taxeld/"]]


def test_a_hello_is_a_greeting_of_version_3_and_the_kind_of_socket() -> None:
    said = zmtp.hello(b"XPUB")
    assert said[:12] == b"\xff" + bytes(8) + b"\x7f\x03\x00"
    assert said[12:64] == b"NULL" + bytes(48)
    assert said[64:] == b"\x04\x1a\x05READY\x0bSocket-Type\x00\x00\x00\x04XPUB"


@given(
    st.lists(st.lists(st.binary(max_size=LARGEST), min_size=1, max_size=FRAMES), max_size=5),
    st.integers(1, 50),
)
def test_messages_arrive_whole_however_they_are_cut(messages: list[list[bytes]], step: int) -> None:
    said = zmtp.hello(b"DEALER") + b"".join(map(zmtp.packed, messages))
    made, found = conversation(), []
    for at in range(0, len(said), step):
        made.take(said[at : at + step])
        found += heard(made)
    assert found == messages


@given(st.lists(st.binary(max_size=200), max_size=20), st.booleans())
def test_any_bytes_are_messages_or_refused_and_little_of_them_is_kept(
    said: list[bytes], greeted: bool
) -> None:
    made = begun() if greeted else conversation()
    try:
        for part in said:
            made.take(part)
            for message in heard(made):
                assert 0 < len(message) <= FRAMES
                assert all(len(frame) <= LARGEST for frame in message)
    except (zmtp.StrangerError, zmtp.OversizedError):
        pass
    assert len(made._buffer) < len(GREETING) + LARGEST + 9 + 200
    assert len(made._parts) < FRAMES


@pytest.mark.parametrize(
    "said",
    [
        b"GET / HTTP/1.1\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
        b"\x01\x00",  # ZMTP 1
        GREETING[:10] + b"\x01\x01" + bytes(52),  # ZMTP 2
        GREETING[:12] + b"CURVE".ljust(20, b"\0") + bytes(32),
        GREETING + zmtp.packed([b"no READY before it"]),
        GREETING + zmtp.packed([b"\x05ERROR\x00"], COMMAND),
        GREETING + zmtp.packed([b"\x05READY"], COMMAND),
        GREETING + zmtp.packed([b"\x05READY\xff\x01"], COMMAND),
        zmtp.hello(b"SUB"),
        zmtp.hello(b"REQ") + b"\x08\x00",
        zmtp.hello(b"REQ") + bytes((COMMAND | MORE, 0)),
    ],
)
def test_who_speaks_otherwise_is_a_stranger(said: bytes) -> None:
    with pytest.raises(zmtp.StrangerError):
        heard(conversation(said))


@pytest.mark.parametrize(
    "said",
    [
        struct.pack(">BQ", LONG, LARGEST + 1),
        struct.pack(">BQ", LONG | MORE, 2**63),
        struct.pack(">BQ", LONG | COMMAND, LARGEST + 1),
        bytes((MORE, 0)) * FRAMES,
    ],
)
def test_too_large_a_message_is_refused_before_it_has_come(said: bytes) -> None:
    made = begun()
    made.take(said)
    with pytest.raises(zmtp.OversizedError):
        heard(made)


def test_a_ping_is_answered_with_its_context() -> None:
    made = begun()
    made.take(zmtp.packed([b"\x04PING\x00\x10context"], COMMAND))
    assert made.next() == []
    assert made.answer == zmtp.packed([b"\x04PONGcontext"], COMMAND)
    made.take(zmtp.packed([b"\x09SUBSCRIBEx"], COMMAND))
    assert made.next() == [], "a command that is not known is none of our concern"
