"""Configuration: every fault is named by its path, endpoints are of this machine alone unless there
are keys, and the documentation is the code's."""

import json
import os
import stat
import tracemalloc
from collections.abc import Callable
from dataclasses import MISSING
from pathlib import Path
from typing import get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from taxeld.config import endpoints
from taxeld.config.file import load, parse
from taxeld.config.gate import ConfigError, keys_of, take
from taxeld.config.tables import OBJECTS_MAX, Config
from taxeld.prior import PosePrior
from taxeld.proposals.manifest import Manifest
from taxeld.stream.curve import takes_keys

SOURCE = '[source]\nkind = "can"\nchannel = "can0"\n'
MINIMAL = SOURCE + '[scene]\nbundle = "box"\n'
LINKS = MINIMAL + "[[skin]]\n{}\n[[skin]]\n{}\n"
ROBOT = '[sensor_pose]\nendpoint = "tcp://127.0.0.1:1"\n'
BEYOND_KEYS = (
    "[relay]\npublish = ['tcp://0.0.0.0:1']\ncontrol = 'tcp://0.0.0.0:1'\n"
    "[sensor_pose]\nendpoint = 'tcp://0.0.0.0:1'"
)
DOCUMENTED = Path(__file__).parents[2] / "examples" / "defaults.toml"


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as error:
        parse(text, "x.toml")
    assert all(line.isprintable() and len(line) < 1100 for line in error.value.faults)
    return error.value.faults


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "source: is required"),
        (SOURCE + "chanel = 'x'", "source.chanel: unknown key; did you mean channel?"),
        ("[source]\nkind = 'usb'", "source.kind: must be one of can, serial, array, not 'usb'"),
        ("[source]\nkind = 'serial'", "source.channel: is required for kind 'serial'"),
        ("[source]\nkind = 'array'\nendpoint = 'tcp://10.0.0.2:1'", "source.endpoint: 'tcp://10."),
        (SOURCE + "modules = [7]", "source.modules[0]: must be a list, not 7"),
        (SOURCE + "modules = [[7]]", "source.modules: [7]: must be [SUI, mask], or all [SUI, ma"),
        (SOURCE + "modules = [[7, 0x1000]]", "source.modules: [7, 4096]: is out of range: SUI 0."),
        (SOURCE + "modules = [[-1, 1]]", "source.modules: [-1, 1]: is out of range: SUI 0..4294"),
        (SOURCE + "modules = [[7, 1, 255]]", "source.modules: [7, 1, 255]: is out of range: SUI"),
        (SOURCE + "modules = [[7, 1], [7, 3]]", "source.modules: lists module 7 more than once"),
        (SOURCE + "modules = [[7, 1], [8, 1, 1]]", "source.modules: [8, 1, 1]: must be [SUI, mas"),
        (MINIMAL + "[speed]\na = 1", "speed: unknown key"),
        (MINIMAL + "[loop]\nrate_hz = 0", "loop.rate_hz: must be 1..1000, not 0"),
        (MINIMAL + '[loop]\n"a\\nb" = 1', "loop.a?b: unknown key"),
        (MINIMAL + "[log]\nlevel = 'loud'", "log.level: must be one of debug, info, warning, err"),
        (MINIMAL + "[filter]\nwithin_m = 10", "filter.within_m: must be 0.001..0.1, not 10"),
        (MINIMAL + "[filter]\ncentre_m = [1]", "filter.centre_m: must be a list of 2, not [1]"),
        (
            MINIMAL + f"[filter]\nseed = 0x{'f' * 9999}",
            "filter.seed: must be an integer, not so large an integer",
        ),
        ("loop = 3\n" + MINIMAL, "loop: must be a table, not 3"),
        (MINIMAL + 'bundles = ["mug"]', "scene.bundles: is given beside scene.bundle; keep one"),
        (SOURCE + '[scene]\nbundles = ["a", "a"]', "scene.bundles: names 'a' more than once"),
        (
            SOURCE + f"[scene]\nbundles = {[str(k) for k in range(OBJECTS_MAX + 1)]}",
            "scene.bundles: names 17 objects; 16 are told apart at most",
        ),
        *(
            (SOURCE + f'[scene]\nbundles = ["a", "b"]\n[filter]\n{key} = "{value}"', fault)
            for key, value, fault in (
                ("injection", "paper", "filter.injection: 'paper' knows one object: name one sc"),
                ("motion", "push", "filter.motion: a pushed object must be known: name one sc"),
            )
        ),
        (
            MINIMAL + '[filter]\nmotion = "push"\ninjection = "paper"',
            "filter.motion: 'push' needs filter.injection = 'mixture'",
        ),
        (SOURCE + "[filter]\nseed = 3", "filter.seed: needs an object: name it in scene.bundle"),
        *(
            (MINIMAL + BEYOND_KEYS, f"{key}: 'tcp://0.0.0.0:1' is not local; use ipc:///path or tc")
            for key in ("relay.publish", "relay.control", "sensor_pose.endpoint")
        ),
        # several links
        ("skin = []\n" + SOURCE + "bitrate = 7", "source.bitrate: must be one of"),
        ("skin = [7]\n" + MINIMAL, "skin[0]: must be a table, not 7"),
        (LINKS.format('name = "a"', 'name = "a"'), "skin[1].name: 'a' is that of skin[0] already"),
        (LINKS.format(*['calibration = "a"'] * 2), "skin[1].calibration: 'a' is that of skin[0]"),
        (LINKS.format("", 'layuot = "x"'), "skin[1].layuot: unknown key; did you mean layout?"),
        (LINKS.format("", "source = {chanel = 1}"), "skin[1].source.chanel: unknown key; did you"),
        (LINKS.format("", 'source = {channel = "x"}'), "skin[1].source.kind: is required"),
        (LINKS.format("", 'source = {kind = "can"}'), "skin[1].source.channel: is required for"),
        (LINKS.format("", 'name = "../x"'), "skin.name: must be the name of a directory, without"),
        (ROBOT + LINKS.format("", ""), "skin[1].sensor_pose.topic: '/robot/sensor_pose' is that"),
        (
            LINKS.format("", 'source = {kind = "can", channel = "can0", period_ms = 9}'),
            "skin[1].source: can can0 is of link1 already, with other keys; name it in [source]",
        ),
        (MINIMAL + "[[skin]]\n" * 9, "skin: has 9 links; 8 at most"),
        *(
            (text, "x.toml: not TOML: ")
            for text in ("a = ", "a = " + "[" * 100_000, f"a = {'9' * 5000}", "a = '\0'")
        ),
    ],
)
def test_each_fault_is_one_line_that_names_its_path(text: str, fault: str) -> None:
    assert any(line.startswith(fault) for line in faults(text)), faults(text)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**400), 10**400) | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=6,
)


@given(table=st.sampled_from([Config, PosePrior, Manifest]), data=st.data())
def test_any_value_is_taken_or_refused_in_a_line(table: type, data: st.DataObject) -> None:
    names = st.sampled_from([key.name for key in keys_of(table)]) | st.text()
    found: list[str] = []
    made = take(table, data.draw(st.dictionaries(names, VALUES)), found)
    assert (made is None) is bool(found)
    assert all(line.isprintable() for line in found)


def test_a_key_of_thousands_of_parts_is_refused_before_it_takes_memory() -> None:
    tracemalloc.start()
    assert faults(f"a{'.a' * 30_000} = 1") == ["x.toml: a key of more than 8 parts: a" + ".a" * 8]
    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_all_faults_are_found_at_once() -> None:
    wrong = MINIMAL + "[loop]\nrate_hz = -1\nspeed = 2\n[filter]\nseed = 'x'\n"
    assert len(faults(wrong)) == 3
    assert len(faults(wrong + "[[skin]]\na = 1\nsource = {b = 2}")) == 6


@pytest.mark.parametrize(
    ("made", "fault"),
    [
        (lambda path: path.write_bytes(b"\xff\xfe"), "'utf-8' codec can't decode"),
        (lambda path: path.write_bytes(b"#" * 70_000), "is larger than 64000 bytes"),
        (os.mkfifo, "is no regular file"),
    ],
    ids=["no text", "too large", "a pipe"],
)
def test_a_file_that_is_no_configuration_is_one_line(
    tmp_path: Path, made: Callable[[Path], object], fault: str
) -> None:
    made(tmp_path / "taxeld.toml")
    with pytest.raises(ConfigError, match=f"^[^\n]+taxeld.toml: unreadable.*{fault}[^\n]*$"):
        load(tmp_path / "taxeld.toml")


def test_one_link_in_an_array_of_tables_is_the_one_skin() -> None:
    one, same = (parse(MINIMAL + f"{t}\nstate_dir = 's'") for t in ("[skin]", "[[skin]]"))
    assert (same.source, same.skin.layout) == (one.source, one.skin.layout)
    assert same.skin.state_dir == "s"


def test_links_without_a_source_share_that_of_all_or_else_the_first_links() -> None:
    own = LINKS.format('source = {kind = "serial", channel = "/dev/skin"}', "")
    shared, alone = (
        [(bus.channel, links) for bus, links in parse(text).buses]
        for text in (own, own.replace(SOURCE, ""))
    )
    assert shared == [("/dev/skin", [0]), ("can0", [1])]
    assert alone == [("/dev/skin", [0, 1])]


def test_the_documented_keys_are_the_codes() -> None:
    lines = []
    for table in keys_of(Config):
        lines += ["", f"[{table.name}]"]
        for key in keys_of(get_type_hints(Config)[table.name]):
            default = '"can"' if key.default is MISSING else json.dumps(key.default)
            lines.append(f"{key.name} = {default} # {key.metadata['doc']}")
    documented = DOCUMENTED.read_text(encoding="utf-8").splitlines()
    assert [" ".join(line.split()) for line in documented[1:]] == lines


CYLINDER = "cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015"


@pytest.mark.parametrize(
    ("scene", "layout", "expected"),
    [
        ('bundle = "bracket"', "skin.json", ("{place}/bracket", "{place}/skin.json")),
        ('bundle = "handle"', CYLINDER, ("handle", CYLINDER)),
        ('bundle = "box"', CYLINDER, ("box", CYLINDER)),
        ('bundles = ["box", "bracket/"]', CYLINDER, ("box", "{place}/bracket", CYLINDER)),
    ],
    ids=["beside the file", "in the shell's directory", "the shipped one", "two"],
)
def test_a_bundle_and_a_layout_are_named_as_seen_from_the_configuration(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    scene: str,
    layout: str,
    expected: tuple[str, ...],
) -> None:
    place, shell = tmp_path / "robot", tmp_path / "shell"
    for path in (place / "bracket", place / "box", place / "skin.json", shell / "handle"):
        path.mkdir(parents=True)
    monkeypatch.chdir(shell)
    text = f'{SOURCE}[scene]\n{scene}\n[skin]\nlayout = "{layout}"\n'
    (place / "skin.toml").write_text(text, encoding="utf-8")
    config = load(place / "skin.toml")
    found = *config.scene.names, config.skin.layout
    assert found == tuple(name.format(place=place) for name in expected)


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
    assert (bare is None, keyed is None) == (endpoint in LOCAL, endpoint not in NONE_AT_ALL)
    if endpoint not in NONE_AT_ALL:
        of_both = endpoints.is_local(endpoint), takes_keys(endpoint)
        assert of_both == (endpoint in LOCAL, endpoint in BEYOND)
    cure = "is not local; use ipc:///path or tcp://127.0.0.1:port, or set curve.dir"
    assert (cure in (bare or "")) is (endpoint in BEYOND)


def test_with_keys_any_of_them_may_lie_beyond_this_machine() -> None:
    assert len(faults(MINIMAL + BEYOND_KEYS)) == 3
    parse(MINIMAL + BEYOND_KEYS + KEYS)


@pytest.mark.parametrize("endpoint", LOCAL[1:3] + BEYOND[:1])
@pytest.mark.parametrize("curve", ["", KEYS])
def test_the_loop_serves_no_network_with_keys_or_without(endpoint: str, curve: str) -> None:
    tables = f"[publish]\nendpoints = ['{endpoint}']\n[control]\nendpoint = '{endpoint}'"
    assert faults(MINIMAL + tables + curve) == [
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
    assert (endpoints.for_this_user(stream), endpoints.no_directory(own)) == (own, None)
    users.mkdir()
    endpoints.make_directory(own)
    assert stat.S_IMODE((users / "taxeld").stat().st_mode) == 0o700
    others = ["ipc:///tmp/x", f"ipc://{services}/a/b", "tcp://127.0.0.1:1", ""]
    assert [*map(endpoints.for_this_user, others)] == others
    services.mkdir(parents=True)
    assert endpoints.for_this_user(stream) == stream, "the service is open to this user"
    services.rmdir()
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert endpoints.for_this_user(stream) == stream
