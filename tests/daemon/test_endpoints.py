"""Endpoints: this machine alone, unless there are keys."""

import stat
from pathlib import Path

import pytest

from taxeld.config import endpoints
from taxeld.config.file import parse
from taxeld.config.gate import ConfigError
from taxeld.stream.curve import takes_keys

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
    "tcp://127.0.0.1",
    "tcp://:9872",
    "tcp://127.0.0.1:*",
    "tcp://127.0.0.1:0",
    "9872",
    "udp://x:1",
    "tcp://127.0.0.1:99999",
    "inproc://a",
    "ipc://run/taxeld",
    "ipc://*",
    "ipc://@abstract",
    f"ipc:///{'x' * 107}",
    f"tcp://127.0.0.1:{'9' * 5000}",
]


@pytest.mark.parametrize("endpoint", LOCAL)
def test_this_machine_takes_no_keys(endpoint: str) -> None:
    assert endpoints.fault(endpoint, has_keys=False) is None
    assert endpoints.is_local(endpoint)
    assert not takes_keys(endpoint)


@pytest.mark.parametrize("endpoint", BEYOND)
def test_what_lies_beyond_is_refused_or_takes_keys(endpoint: str) -> None:
    fault = endpoints.fault(endpoint, has_keys=False)
    assert fault is not None
    assert "is not local; use ipc:///path or tcp://127.0.0.1:port, or set curve.dir" in fault
    assert endpoints.fault(endpoint, has_keys=True) is None
    assert takes_keys(endpoint)


@pytest.mark.parametrize("endpoint", NONE_AT_ALL)
def test_what_is_no_endpoint_is_refused_with_keys_as_well(endpoint: str) -> None:
    assert endpoints.fault(endpoint, has_keys=True) is not None


@pytest.mark.parametrize(
    "table",
    [
        "[relay]\npublish = ['tcp://127.0.0.1:1', '{}']",
        "[relay]\ncontrol = '{}'",
        "[sensor_pose]\nendpoint = '{}'",
    ],
)
def test_each_fault_is_one_line_that_names_its_key(table: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse(MINIMAL + table.format("tcp://0.0.0.0:1"))
    (line,) = error.value.faults
    key = table.replace("[", "").replace("]\n", ".").split(" =", maxsplit=1)[0]
    assert line.startswith(f"{key}: 'tcp://0.0.0.0:1' is not local")
    parse(MINIMAL + table.format("tcp://0.0.0.0:1") + "\n[curve]\ndirectory = '/keys'")


@pytest.mark.parametrize(
    ("table", "key", "relay_key"),
    [
        ("[publish]\nendpoints = ['ipc:///a', '{}']", "publish.endpoints", "relay.publish"),
        ("[control]\nendpoint = '{}'", "control.endpoint", "relay.control"),
    ],
)
@pytest.mark.parametrize("curve", ["", "\n[curve]\ndirectory = '/keys'"])
def test_the_loop_serves_no_network_with_keys_or_without(
    table: str, key: str, relay_key: str, curve: str
) -> None:
    for endpoint in LOCAL[1:] + BEYOND:
        with pytest.raises(ConfigError) as error:
            parse(MINIMAL + table.format(endpoint) + curve)
        (line,) = error.value.faults
        assert line.startswith(f"{key}: '{endpoint}' is of TCP: name it in {relay_key}; here stand")


def test_a_users_own_daemon_has_its_sockets_in_the_users_runtime_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    services, users = tmp_path / "run" / "taxeld", tmp_path / "user"
    monkeypatch.setattr(endpoints, "RUNTIME", services)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(users))
    stream = f"ipc://{services}/stream"
    own = f"ipc://{users}/taxeld/stream"
    assert endpoints.for_this_user(stream) == own
    assert endpoints.no_directory(own) is None
    users.mkdir()
    endpoints.make_directory(own)
    assert stat.S_IMODE((users / "taxeld").stat().st_mode) == 0o700
    for other in ("ipc:///tmp/x", f"ipc://{services}/a/b", "tcp://127.0.0.1:1", ""):
        assert endpoints.for_this_user(other) == other
    services.mkdir(parents=True)
    assert endpoints.for_this_user(stream) == stream, "the service is open to this user"
    services.rmdir()
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert endpoints.for_this_user(stream) == stream
