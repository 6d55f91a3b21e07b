"""What comes to a run: the scans of its sources, and the robot's poses."""

import contextlib
import time

from taxeld.config.tables import SourceConfig
from taxeld.layout.layout import Layout
from taxeld.pipeline.pose_watch import PoseFigures, PoseWatch
from taxeld.service.prepare import Prepared
from taxeld.source import buses
from taxeld.source.buses import Bus
from taxeld.source.recorder import Recorder
from taxeld.source.source import Source
from taxeld.source.sources import open_source
from taxeld.stream.link import Link
from taxeld_protocol.decoder import Scan

GATHER_S = 0.0002  # silence after a whole scan: its frames follow each other more closely
GATHERS = 20  # looks at the device for further frames, GATHER_S apart


class Inputs:
    """The sources of one run, and the watch over the first link's poses."""

    def __init__(self, made: Prepared) -> None:
        self._made, self._robot = made, made.config.sensor_pose.endpoint
        self.watch = PoseWatch(self._robot, made.config.source.period_ms / 1000.0)
        self.buses = list[Bus]()

    def open(self, link: Link, recorder: Recorder | None, opened: contextlib.ExitStack) -> None:
        """Open all sources, until `opened` ends; those that come by the door come by `link`.

        Raises:
            SetupError: one of them cannot be used.
        """

        def open_one(config: SourceConfig, layout: Layout, first: int) -> Source:
            record = recorder.of(first) if recorder else None
            source = open_source(config, layout, record, wait=True)
            opened.callback(source.close)
            if source.comes_by_door:
                link.on_array = source.hear
            return source

        self.buses = buses.opened(self._made.config, self._made.layouts, open_one)
        for bus in self.buses:
            wirings = [self._made.pipeline.stages[k].skin.wiring for k in bus.links]
            for wiring in wirings:
                wiring.neighbours = {sui for each in wirings for sui in each.suis}

    @property
    def sources(self) -> list[Source]:
        """One for each bus; the first is the first link's."""
        return [bus.source for bus in self.buses]

    @property
    def source(self) -> Source:
        """The first link's."""
        return self.buses[0].source

    @property
    def come_by_door(self) -> bool:
        """Whether scans come by the door, as those of an array do."""
        return any(source.comes_by_door for source in self.sources)

    @property
    def waits_for(self) -> str:
        """What each source waits for, with its links where there are several."""
        if len(self.buses) == 1:
            return self.source.waits_for
        return "; ".join(
            f"{', '.join(self._made.config.names[k] for k in bus.links)}: {bus.source.waits_for}"
            for bus in self.buses
            if bus.source.waits_for
        )

    @property
    def openings(self) -> int:
        """How often a device was opened again, or was tried to be."""
        return sum(each.counters.unopened + each.counters.reopened for each in self.sources)

    def on_pose(self, t: float, x: float, y: float, theta: float, link: int = 0) -> None:
        """A pose of a link's sensor has come."""
        now, poses = time.time(), self._made.pipeline.stages[link].poses
        far = poses.far
        poses.add(t, x, y, theta, now)
        if not link:
            self.watch.add(t, now, is_far=poses.far > far)

    def gather(self) -> None:
        """Wait until the frames that come are a whole scan: a pass for each of them would cost more
        than all work on the scan."""
        held = 0
        for _ in range(GATHERS):
            before, held = held, sum(source.gather() for source in self.sources)
            if held == before:
                return
            time.sleep(GATHER_S)

    def poll(self, now_s: float) -> list[list[Scan]]:
        """The scans of each link that have come; `now_s` is monotonic."""
        return buses.polled(self.buses, now_s)

    def pose_figures(self, link: Link, t: float) -> PoseFigures:
        """Figures of the robot's poses at the Unix time t; to be called once a second."""
        if not self._robot:
            return PoseFigures()
        line = link.report.robot
        state = {"connected": line.connected, "refused": line.refused, "is_heard": link.is_heard}
        return self.watch.look(t, line.malformed, line.reason, line.topics, **state)
