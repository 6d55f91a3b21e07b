"""Endpoints: this machine alone, unless there are keys."""

import pytest

from taxeld import endpoints
from taxeld.config import CurveConfig, parse
from taxeld.curve import takes_keys
from taxeld.toml_tables import ConfigError

MINIMAL = '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
LOCAL = [
    "ipc:///run/taxeld/stream",
    "tcp://127.0.0.1:9872",
    "tcp://127.0.0.2:1",
    "tcp://localhost:65535",
    "tcp://[::1]:9872",
]
BEYOND = [
    "tcp://0.0.0.0:9872",
    "tcp://*:9872",
    "tcp://[::]:9872",
    "tcp://192.168.1.7:9872",
    "tcp://10.0.0.1:9872",
    "tcp://[fe80::1]:9872",
    "tcp://eth0:9872",
    "tcp://robot:9872",
    "tcp://localhost.example.org:9872",
    "tcp://127.0.0.1.example.org:9872",
    "tcp://127.0.0.1:0;10.0.0.5:9872",  # ZeroMQ's form for a source address
]
NONE_AT_ALL = [
    "tcp://127.0.0.1", "tcp://:9872", "tcp://127.0.0.1:*", "tcp://127.0.0.1:0", "9872", "udp://x:1",
    "tcp://127.0.0.1:99999", "inproc://a", "ipc://run/taxeld", "ipc://*", "ipc://@abstract",
    f"ipc:///{'x' * 107}",
]  # fmt: skip


@pytest.mark.parametrize("endpoint", LOCAL)
def test_this_machine_takes_no_keys(endpoint: str) -> None:
    assert endpoints.fault(endpoint, has_keys=False) is None
    assert endpoints.is_local(endpoint)
    assert not takes_keys(endpoint, CurveConfig("/keys"))


@pytest.mark.parametrize("endpoint", BEYOND)
def test_what_lies_beyond_is_refused_or_takes_keys(endpoint: str) -> None:
    fault = endpoints.fault(endpoint, has_keys=False)
    assert fault is not None
    assert "is not local; use ipc:///path or tcp://127.0.0.1:port, or set curve.dir" in fault
    assert endpoints.fault(endpoint, has_keys=True) is None
    assert takes_keys(endpoint, CurveConfig("/keys"))


@pytest.mark.parametrize("endpoint", NONE_AT_ALL)
def test_what_is_no_endpoint_is_refused_with_keys_as_well(endpoint: str) -> None:
    assert endpoints.fault(endpoint, has_keys=True) is not None


def test_on_request_tcp_takes_keys_on_this_machine_too() -> None:
    curve = CurveConfig("/keys", loopback=True)
    assert takes_keys("tcp://127.0.0.1:9872", curve)
    assert not takes_keys("ipc:///run/taxeld/stream", curve)


@pytest.mark.parametrize(
    "table",
    ["[publish]\nendpoints = ['tcp://127.0.0.1:1', '{}']", "[control]\nendpoint = '{}'",
     "[sensor_pose]\nendpoint = '{}'"],
)  # fmt: skip
def test_each_fault_is_one_line_that_names_its_key(table: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse(MINIMAL + table.format("tcp://0.0.0.0:1"))
    (line,) = error.value.faults
    key = table.replace("[", "").replace("]\n", ".").split(" =", maxsplit=1)[0]
    assert line.startswith(f"{key}: 'tcp://0.0.0.0:1' is not local")
    parse(MINIMAL + table.format("tcp://0.0.0.0:1") + "\n[curve]\ndirectory = '/keys'")
