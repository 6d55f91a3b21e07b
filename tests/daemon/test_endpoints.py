"""Endpoints: this machine alone, unless there are keys."""

import stat
from pathlib import Path

import pytest

from taxeld.config import endpoints
from taxeld.config.file import parse
from taxeld.config.gate import ConfigError
from taxeld.stream.curve import takes_keys

MINIMAL = '[source]\nkind = "can"\nchannel = "can0"\n[scene]\nbundle = "box"\n'
KEYS = "\n[curve]\ndirectory = '/keys'"
LOCAL = [
    *("ipc:///run/taxeld/stream", "tcp://127.0.0.1:9872", "tcp://127.0.0.2:1"),
    *("tcp://localhost:65535", "tcp://[::1]:9872"),
]
BEYOND = [
    *("tcp://0.0.0.0:9872", "tcp://*:9872", "tcp://[::]:9872", "tcp://192.168.1.7:9872"),
    *("tcp://10.0.0.1:9872", "tcp://[fe80::1]:9872", "tcp://eth0:9872", "tcp://robot:9872"),
    *("tcp://localhost.example.org:9872", "tcp://127.0.0.1.example.org:9872"),
    "tcp://127.0.0.1:0;10.0.0.5:9872",  # ZeroMQ's form for a source address
]
NONE_AT_ALL = [
    *("tcp://127.0.0.1", "tcp://:9872", "tcp://127.0.0.1:*", "tcp://127.0.0.1:0", "9872"),
    *("udp://x:1", "tcp://127.0.0.1:99999", "inproc://a", "ipc://run/taxeld", "ipc://*"),
    *("ipc://@abstract", f"ipc:///{'x' * 107}", f"tcp://127.0.0.1:{'9' * 5000}"),
]


@pytest.mark.parametrize("endpoint", [*LOCAL, *BEYOND, *NONE_AT_ALL])
def test_what_lies_beyond_this_machine_is_refused_or_takes_keys(endpoint: str) -> None:
    bare, keyed = (endpoints.fault(endpoint, has_keys=has) for has in (False, True))
    assert (bare is None) is (endpoint in LOCAL)
    assert (keyed is None) is (endpoint not in NONE_AT_ALL)
    if endpoint not in NONE_AT_ALL:
        assert endpoints.is_local(endpoint) is (endpoint in LOCAL)
        assert takes_keys(endpoint) is (endpoint in BEYOND)
    if endpoint in BEYOND:
        assert bare
        assert "is not local; use ipc:///path or tcp://127.0.0.1:port, or set curve.dir" in bare


@pytest.mark.parametrize(
    ("key", "table"),
    [
        ("relay.publish", "[relay]\npublish = ['tcp://127.0.0.1:1', '{}']"),
        ("relay.control", "[relay]\ncontrol = '{}'"),
        ("sensor_pose.endpoint", "[sensor_pose]\nendpoint = '{}'"),
    ],
)
def test_each_fault_is_one_line_that_names_its_key(key: str, table: str) -> None:
    text = MINIMAL + table.format("tcp://0.0.0.0:1")
    with pytest.raises(ConfigError) as error:
        parse(text)
    (line,) = error.value.faults
    assert line.startswith(f"{key}: 'tcp://0.0.0.0:1' is not local")
    parse(text + KEYS)


@pytest.mark.parametrize("endpoint", LOCAL[1:3] + BEYOND[:1])
@pytest.mark.parametrize("curve", ["", KEYS])
def test_the_loop_serves_no_network_with_keys_or_without(endpoint: str, curve: str) -> None:
    tables = f"[publish]\nendpoints = ['{endpoint}']\n[control]\nendpoint = '{endpoint}'"
    with pytest.raises(ConfigError) as error:
        parse(MINIMAL + tables + curve)
    assert error.value.faults == [
        f"{key}: '{endpoint}' is of TCP: name it in {relay}; here stands ipc:///path alone"
        for key, relay in (
            ("publish.endpoints", "relay.publish"),
            ("control.endpoint", "relay.control"),
        )
    ]


def test_a_users_own_daemon_has_its_sockets_in_the_users_runtime_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    services, users = tmp_path / "run" / "taxeld", tmp_path / "user"
    monkeypatch.setattr(endpoints, "RUNTIME", services)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(users))
    stream, own = f"ipc://{services}/stream", f"ipc://{users}/taxeld/stream"
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
