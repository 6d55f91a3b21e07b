"""What comes to a run: the scans of its sources and the robot's poses; and what is wrong with the
latter (docs/troubleshooting.md has more mistakes, by the counts of `taxeld status`)."""

import contextlib
import math
from collections import deque
from collections.abc import Mapping, Sequence

from taxeld.config.tables import Config, SourceConfig
from taxeld.layout.layout import Layout
from taxeld.pipeline.poses import FAR_M
from taxeld.service.doorkeeper import Doorkeeper, poses_alone
from taxeld.service.surroundings import MACHINE, Surroundings
from taxeld.source.opening import open_sources
from taxeld.source.recorder import Recorder
from taxeld.source.sources import ArraySource, LiveSource, Source, polled
from taxeld.stream.link import Link, PeerLine
from taxeld_protocol.decoder import Scan

LOOKS = 5  # looks at the poses, a second each, over which their rate and clock are judged
SEEN = 3  # looks in a row that must show a fault: a busy machine is late now and then
OFFSET_S = 0.05  # between the robot's clock and this one
SLOW = 0.9  # share of the scans' rate: fewer poses are too few
STOPPED_S = 1.0  # without a pose, after which they have stopped
NEVER_S = -1.0  # age reported before the first pose


class PoseWatch:
    """Follows the first link's poses as they come, and sums them up once a second."""

    def __init__(self, endpoint: str, scan_period_s: float) -> None:
        self.fault = ""  # the fault with its cure, once it was seen SEEN times
        self.rate_hz, self.age_s = 0.0, NEVER_S
        self.offset_s = 0.0  # least delay of the poses' times behind this clock in the last looks
        self.endpoint, self._scans_hz = endpoint, 1.0 / scan_period_s
        self._received = self._malformed = 0
        self._is_far = False  # a pose since the last look was
        self._found, self._times = "", 0  # fault at the last look, and how often it was seen
        self.clock_stepped()

    def clock_stepped(self) -> None:
        """Forget the measurements: they are of another clock."""
        # at each look: its time, the poses so far, and the least offset since the one before
        self._looks: deque[tuple[float, int, float]] = deque(maxlen=LOOKS)
        self._nearest_s, self._came_s = math.inf, math.nan

    def add(self, t: float, now: float, *, is_far: bool = False) -> None:
        """A pose of Unix time t has come `now`, used or not; `is_far`: too far from the origin."""
        self._is_far |= is_far
        self._received += 1
        self._came_s = now
        self._nearest_s = min(self._nearest_s, now - t, key=abs)

    def look(self, now: float, line: PeerLine, *, is_heard: bool) -> None:
        """Sum up at the Unix time `now`; `line`: what the door says of the robot. Unless the door
        `is_heard`, nothing is known of the robot, and the fault stays as it was."""
        self.age_s = NEVER_S if math.isnan(self._came_s) else max(now - self._came_s, 0.0)
        self._looks.append((now, self._received, self._nearest_s))
        then, before, _ = self._looks[0]
        self.rate_hz = (self._received - before) / (now - then) if now > then else 0.0
        offsets = [offset for *_, offset in self._looks if math.isfinite(offset)]
        self.offset_s = min(offsets, key=abs, default=self.offset_s)
        found = self._judge(line) if is_heard else self.fault
        self._times = self._times + 1 if found == self._found else 1
        if self._times >= SEEN or not found:
            self.fault = found
        self._found, self._malformed, self._nearest_s = found, line.malformed, math.inf
        self._is_far = False

    def _judge(self, line: PeerLine) -> str:
        at = self.endpoint
        if line.malformed > self._malformed:
            return f"messages come and are no poses: {line.reason}"
        if not 0.0 <= self.age_s <= STOPPED_S:
            if line.refused:
                return f"{at} refuses the daemon: both must use keys, or neither (curve.directory)"
            if not line.connected:
                return f"nobody serves {at}: start the publisher; it binds, the daemon connects"
            return f"connected to {at}, and no pose comes: publish /robot/sensor_pose"
        is_known = len(self._looks) == LOOKS
        if is_known and abs(self.offset_s) > OFFSET_S:
            return (
                "their times are not of this machine's clock: send Unix time in seconds, and let "
                "chrony or PTP keep both clocks"
            )
        if self._is_far:
            return f"x or y is beyond {FAR_M:g} m: send metres, not millimetres"
        if is_known and self.rate_hz < SLOW * self._scans_hz:
            return "fewer poses than scans come: publish 100 a second"
        return ""


class Inputs:
    """The sources of one run, and the door by which poses and arrays come; to be closed."""

    def __init__(
        self,
        config: Config,
        layouts: Sequence[Layout],
        link: Link,
        recorder: Recorder | None = None,
        door: Doorkeeper | None = None,
        around: Surroundings = MACHINE,
    ) -> None:
        """Open all sources; `layouts`: of each link. `recorder` gets what the devices read. A
        daemon has a `door` of its own, and devices that are away are opened later; else one is
        started that serves nobody.

        Raises:
            SetupError: one of them cannot be used.
        """
        self._names, self._link = config.names, link
        self.watch = PoseWatch(config.sensor_pose.endpoint, config.source.period_ms / 1000.0)
        is_daemon = door is not None

        def open_one(source: SourceConfig, skins: Mapping[int, Layout]) -> Source:
            if source.kind == "array":
                return ArraySource(source, skins, recorder, around.unix)
            opens, clock = around.open_device, around.monotonic
            return LiveSource(source, skins, opens, recorder, wait=is_daemon, clock=clock)

        with contextlib.ExitStack() as opened:
            self.door = door or Doorkeeper(poses_alone(config), around)
            opened.enter_context(contextlib.closing(self.door))
            # that of the first link first
            self.sources = open_sources(config, layouts, open_one, opened)
            arrays = (source for source in self.sources if isinstance(source, ArraySource))
            self.array = next(arrays, None)
            if self.array is not None:
                link.on_array = self.array.hear
            if door is None:
                self.door.wait(link)
            self.close = opened.pop_all().close

    def poll(self, now_s: float) -> list[Scan]:
        """Take all that has come by the monotonic time `now_s`; → scans."""
        self.door.look(now_s)
        return polled(self.sources, now_s)

    @property
    def waits_for(self) -> str:
        """What each source waits for, with its links where there are several."""
        if len(self.sources) == 1:
            return self.sources[0].waits_for
        return "; ".join(
            f"{', '.join(self._names[k] for k in each.links.numbers)}: {each.waits_for}"
            for each in self.sources
            if each.waits_for
        )

    def look(self, t: float) -> None:
        """Once a second, at the Unix time t: take what the door says of robot and array."""
        report = self._link.report
        if self.watch.endpoint:
            self.watch.look(t, report.robot, is_heard=self._link.is_heard)
        if self.array is not None:
            line = report.array
            self.array.heed(connected=line.connected, malformed=line.malformed, reason=line.reason)
