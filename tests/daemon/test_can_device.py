"""Sources on interfaces of python-can; its virtual bus stands in for an adapter's driver."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from can.interfaces.virtual import VirtualBus

from taxeld.config.tables import SourceConfig
from taxeld.source.device import LostError
from taxeld.source.opening import open_device, open_source
from taxeld.source.recorder import Recorder
from taxeld.source.sources import LiveSource
from taxeld_protocol.frames import Frame
from tests.rig.sessions import items_of
from tests.rig.skins import LISTED, SKIN

SILENT = Frame(0.0, 0x17FFFFFF, bytes.fromhex("013B00004F6D17"), extended=True)


def config_of(channel: str, **keys: Any) -> SourceConfig:
    return SourceConfig(kind="can", interface="virtual", channel=channel, **keys)


@pytest.fixture
def bus(request: pytest.FixtureRequest) -> Iterator[can.BusABC]:
    """The other end; the channel has the test's name."""
    with can.Bus(interface="virtual", channel=request.node.name) as made:
        yield made


@pytest.mark.parametrize(("known", "kind"), [(True, "off"), (False, "error")])
def test_an_error_frame_tells_what_the_kernels_do_or_is_a_damaged_frame(
    bus: can.BusABC,
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    known: bool,
    kind: str,
) -> None:
    monkeypatch.setattr("taxeld.source.can_device.AS_THE_KERNEL", ["virtual"] * known)
    config = config_of(request.node.name, listen_only=True, modules=LISTED)
    source = LiveSource(config, {0: SKIN}, open_device)
    bus.send(can.Message(arbitration_id=0x40, is_error_frame=True))
    source.poll(0.0)
    assert {fault for fault, n in source.bus.counts.items() if n} == {kind}
    source.close()


def test_what_goes_out_is_recorded_as_candump_would_and_a_full_bus_is_waited_for(
    bus: can.BusABC,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object, **__: object) -> None:
        raise can.CanOperationError("Transmit buffer full")

    session = tmp_path / "session"
    with Recorder(session, moves=False) as recorder:
        source = open_source(config_of(request.node.name), {0: SKIN}, recorder)
        for tick in range(100):
            with monkeypatch.context() as patched:
                if tick < 20:
                    patched.setattr(VirtualBus, "send", full)
                source.poll(0.01 * tick)
        source.close()
    heard = iter(lambda: bus.recv(0.0), None)
    sent = [Frame(0.0, m.arbitration_id, bytes(m.data), m.is_extended_id) for m in heard if m]
    assert source.counters.unsent == 0
    assert sent[0] == SILENT
    assert [item._replace(t=0.0) for item in items_of(session)] == sent  # type: ignore[call-arg]
    line, *_ = (session / "frames.log").read_text(encoding="ascii").split("\n")
    assert line.endswith(" can0 17FFFFFF#013B00004F6D17")


@pytest.mark.parametrize(("behind_s", "kept"), [(0.02, True), (7200.0, True), (1e8, False)])
def test_stamps_of_an_adapters_own_clock_are_replaced_by_the_arrivals(
    monkeypatch: pytest.MonkeyPatch, behind_s: float, kept: bool
) -> None:
    """Some count from their start; the kernel's are believed, however old."""
    stamp = time.time() - behind_s
    waiting = [can.Message(timestamp=stamp, arbitration_id=0x101, data=b"\x43")]
    monkeypatch.setattr(VirtualBus, "recv", lambda *_: waiting.pop() if waiting else None)
    device = open_device(config_of("stamps"))
    (frame,) = device.read()
    assert isinstance(frame, Frame)
    assert (frame.t == stamp) == kept
    assert kept or frame.t > stamp + 1e7
    device.close()


def test_a_bus_without_a_descriptor_is_polled_and_one_that_fails_is_lost_after_its_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    say: list[object] = [
        can.Message(arbitration_id=0x101, data=b"\x43", is_extended_id=False),
        can.Message(arbitration_id=0x101, is_remote_frame=True),
        can.Message(arbitration_id=0x101, is_fd=True),
        ValueError("damaged"),
        can.Message(arbitration_id=0x102, data=b"", is_extended_id=False),
        can.CanOperationError("gone"),
    ]

    def next_one(*_: object) -> object:
        said = say.pop(0) if say else None
        if isinstance(said, Exception):
            raise said
        return said

    monkeypatch.setattr(VirtualBus, "recv", next_one)
    device = open_device(config_of("x"))
    assert device.fileno() < 0
    read = [[f.can_id for f in device.read() if isinstance(f, Frame)] for _ in range(2)]
    assert (read, device.noticed.foreign) == ([[0x101], [0x102]], 2)
    with pytest.raises(LostError):
        device.read()
    device.close()
