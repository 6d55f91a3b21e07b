"""`taxeld check`: opens everything that a run opens, by the same functions, and closes it again.

Nothing is sent to a device, and no request of a peer is answered.
"""

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import zmq

from taxeld.config import endpoints
from taxeld.config.tables import Config, SourceConfig
from taxeld.door.binding import NotNowError, bound
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.proposals import bundle, choice
from taxeld.service import calibration_file
from taxeld.source.device import AwayError, BusyError
from taxeld.source.links import check_uids, joint
from taxeld.source.opening import open_device
from taxeld.source.socketcan import bring_up
from taxeld.source.sources import live
from taxeld.stream import client, curve

SYS_NET = Path("/sys/class/net")
IS_UP = 0x1  # IFF_UP

MODULES_TO_COME = (
    "source.modules: lists none, so taxeld must listen already when the skin is started, to hear "
    "which modules its hub has"
)

ALONE = "scene.bundle: is empty: the skin is served alone, and nothing is estimated"

ASK_S = 0.5  # for a daemon to answer


def faults(config: Config) -> list[str]:
    """Lines on the faults of a configuration with valid keys, each with its path. Where a daemon
    answers at its control endpoint, a device or endpoint in use is no fault."""
    found, busy = list[str](), list[str]()

    def attempt(step: Callable[..., object], *args: object) -> None:
        try:
            step(*args)
        except (BusyError, NotNowError) as error:
            busy.append(str(error))
        except SetupError as error:
            found.append(str(error))

    def use_layouts() -> None:
        skins = [layouts.load(one.skin.layout) for one in config.each]
        for bus, numbers in config.buses:
            own = [skins[k] for k in numbers]
            attempt(check_uids, [config.names[k] for k in numbers], own)
            if bus.kind != "array":
                attempt(live, bus, joint(own))
        if config.scene.names:
            attempt(_open_bundle, config, skins)
        for one, skin in zip(config.each, skins, strict=True):
            attempt(calibration_file.load, one.skin, skin, time.time())

    attempt(use_layouts)
    for bus, _ in config.buses:
        if bus.kind in ("can", "serial"):
            attempt(_open, bus)
    served = (*config.relay.publish, config.relay.control)
    attempt(curve.read_keys, config.curve.directory, config.sensor_pose.endpoint, served)
    for key, endpoint in config.served:
        attempt(_serve, endpoint, key)
    control = config.control.endpoint
    is_running = busy and control and client.ask(control, "info", ASK_S) is not None
    return found if is_running else found + busy


def _open(source: SourceConfig) -> None:
    """Open a device for a moment. python-can's drivers have no error for one that is in use."""
    try:
        open_device(source).close()
    except AwayError as error:
        if source.kind == "can" and source.interface not in ("socketcan", "slcan"):
            raise BusyError(str(error)) from None
        raise


def notes(config: Config) -> list[str]:
    """Lines on matters that no check can decide."""
    source = config.source
    to_come = MODULES_TO_COME * (source.listen_only and not source.modules)
    return [*filter(None, (ALONE * (not config.scene.names), _down(source), to_come))]


def _open_bundle(config: Config, skins: Sequence[Layout]) -> None:
    bundles = bundle.load_all(config.scene, skins, config.skin.full_scale_depth_m)
    for name in choice.possible(bundles, config.filter):
        for one in bundles:
            one.open(name)


def _serve(endpoint: str, key: str) -> None:
    endpoints.make_directory(endpoint)
    with zmq.Context() as context, context.socket(zmq.XPUB) as socket, bound(socket, endpoint, key):
        pass


def _down(source: SourceConfig) -> str:
    """A line on how to bring up a CAN interface that exists and is down; a run waits for that."""
    if source.kind == "can" and source.interface == "socketcan":
        with contextlib.suppress(OSError, ValueError):
            flags = (SYS_NET / source.channel / "flags").read_text(encoding="ascii")
            if not int(flags, 16) & IS_UP:
                return f"source.channel: {source.channel} is down; bring it up: {bring_up(source)}"
    return ""
