"""A bus of python-can's that has no descriptor: the loop waits on one of its own thread's."""

import select
import threading
import time
from collections.abc import Iterator

import can
import pytest

from taxeld.config.tables import SourceConfig
from taxeld.source import can_device
from taxeld.source.can_device import BusThread, CanDevice
from taxeld.source.device import LostError
from taxeld_protocol.frames import Frame

PATIENCE_S = 20.0


@pytest.fixture
def device() -> Iterator[CanDevice]:
    config = SourceConfig(kind="can", interface="virtual", channel="thread")
    made = CanDevice(config, lambda *_: [])
    yield made
    made.close()


@pytest.fixture
def hub() -> Iterator[can.BusABC]:
    with can.Bus(interface="virtual", channel="thread") as bus:
        yield bus


def is_readable(device: CanDevice, seconds: float = PATIENCE_S) -> bool:
    return bool(select.select([device], [], [], seconds)[0])


def say(hub: can.BusABC, *numbers: int) -> None:
    for number in numbers:
        hub.send(can.Message(arbitration_id=number, data=[7], is_extended_id=False))


def heard(device: CanDevice, count: int) -> list[int]:
    frames: list[Frame] = []
    deadline = time.monotonic() + PATIENCE_S
    while len(frames) < count:
        assert time.monotonic() < deadline
        assert is_readable(device)
        frames += device.read()
    return [frame.can_id for frame in frames]


def test_what_comes_wakes_who_waits_and_is_read_in_order(
    device: CanDevice, hub: can.BusABC
) -> None:
    assert not is_readable(device, 0.0)
    for round_ in range(50):
        say(hub, *range(round_, round_ + 3))
        assert heard(device, 3) == list(range(round_, round_ + 3))
    assert device.read() == []
    assert not is_readable(device, 0.0), "and nothing wakes anybody once all is read"


def test_who_never_waits_has_no_thread(device: CanDevice, hub: can.BusABC) -> None:
    before = threading.active_count()
    say(hub, 1, 2)
    assert [frame.can_id for frame in device.read()] == [1, 2]
    assert threading.active_count() == before


def test_a_flood_that_nobody_reads_stays_in_the_driver(
    device: CanDevice, hub: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(can_device, "HELD", 10)
    device.fileno()
    assert device._thread is not None
    say(hub, *range(100))
    assert is_readable(device)
    assert device._thread._held.qsize() <= 10
    assert heard(device, 100) == list(range(100))


class Broken:
    """A bus that raises what it is told to, and else waits as long as it is asked to."""

    def __init__(self, *errors: Exception) -> None:
        self.errors = list(errors)

    def _recv_internal(self, timeout: float) -> tuple[None, bool]:
        if self.errors:
            raise self.errors.pop(0)
        time.sleep(timeout)
        return None, False


def test_a_bus_that_is_gone_is_said_to_who_reads(device: CanDevice) -> None:
    broken = BusThread(Broken(ValueError("damaged"), can.CanOperationError("gone")))
    device._thread = broken
    while not device.noticed.noise:  # what cannot be decoded is counted
        assert is_readable(device)
        assert device.read() == []
    with pytest.raises(LostError):
        heard(device, 1)
    broken._thread.join(PATIENCE_S)
    assert not broken._thread.is_alive()
    assert device.noticed.noise == 1


def test_closing_ends_the_thread(device: CanDevice) -> None:
    device.fileno()
    assert device._thread is not None
    thread = device._thread._thread
    device.close()
    assert not thread.is_alive()
