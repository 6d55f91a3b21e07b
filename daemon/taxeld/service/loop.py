"""The loop: it alone owns clocks, sockets and devices.

It sleeps until something arrives, or until its clock says so. It takes the arrivals; a pass works
on each scan to its end and publishes the results. A pass without arrivals makes a search, if the
pipeline has one to make.
"""

import contextlib
import gc
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

from taxeld.config.tables import Config
from taxeld.pipeline.poses import FAR_M
from taxeld.prior import PosePrior
from taxeld.proposals import bundle
from taxeld.service import realtime
from taxeld.service.clock import ALL, Ready, Ticker, WallClock
from taxeld.service.doorkeeper import Doorkeeper, settings_of
from taxeld.service.inputs import Inputs
from taxeld.service.kept import Store
from taxeld.service.notify import Notifier
from taxeld.service.prepare import digest, prepared
from taxeld.service.publisher import LoopCounters, Publisher
from taxeld.service.surroundings import MACHINE, Surroundings
from taxeld.source.recorder import Recorder
from taxeld.source.session import ClockStep, Item, Pass, SensorPose
from taxeld.source.sources import Source, polled
from taxeld.stream import messages
from taxeld.stream.link import Link
from taxeld_protocol.decoder import Scan

TOUCH_SHARE = 0.8  # share of the time until the next scan that a touch may take
START_S = 2.0  # time that a skin may take to start, before the lack of scans is a fault
ANSWER_S = 0.005  # time that the door has for the poses of a scan
GATHER_S = 0.0002  # time between two looks at the device: a scan's frames come more closely
GATHERS = 20  # further looks at the device for the rest of a scan
COLLECT_S = 60.0  # an attempt to open a device of python-can leaves about 36 objects
LOOK_S = 0.05  # time between looks at the door while no scan waits for a pose

log = logging.getLogger(__name__)


class Daemon:
    """A configuration in operation."""

    def __init__(
        self, config: Config, recorder: Recorder | None = None, around: Surroundings = MACHINE
    ) -> None:
        """Open everything that a run needs; `recorder` gets the input from skin and robot, and is
        entered already. `around`: the machine.

        Raises:
            SetupError: a part of it cannot be used.
        """
        with contextlib.ExitStack() as opened:
            # the doors' processes start while the slow parts here load
            keepers = [contextlib.closing(Doorkeeper(each, around)) for each in settings_of(config)]
            self.doors = [opened.enter_context(each) for each in keepers]
            made = prepared(config, around.unix(), around.work_ns, load=around.bundles)
            self.config, self.layouts, self.pipeline = made.config, made.layouts, made.pipeline
            self.pipeline.thinks_at_once = False
            self._objects = bundle.scenes(made.bundles)
            self.counters = LoopCounters()
            self.clock = WallClock(around.unix, around.monotonic)
            self.realtime, self.recorder = realtime.RealTime(), recorder
            self.around, self.start_s = around, around.monotonic()
            self.pipeline.freshness.came(self.start_s)  # counted as if a scan had come at the start
            self._next_look_s, self._source_ns = 0.0, 0  # CPU time of taking the last scans
            self.kept = Store(self.config, self.pipeline, around)
            changes = {"tare": self._tare, "reset": self._reset, "prior": self._prior}
            info = self._info()
            self.link = Link(info, self.on_pose, changes, Link(info, self.on_pose, changes))
            opened.callback(self.kept.close)
            given = self.config, self.layouts, self.link, recorder, self.doors[0]
            self.inputs = Inputs(*given, around)
            opened.enter_context(contextlib.closing(self.inputs))
            self.publisher = Publisher(made, self.inputs, self.link, self.counters, around)
            for door, link in zip(self.doors, self.link.doors, strict=True):
                door.wait(link)
            self._opened = opened.pop_all()

    def _info(self) -> dict[str, object]:
        several_links = len(self.layouts) > 1
        named = dict(zip(self.config.names, self.layouts, strict=True)) if several_links else {}
        return messages.info(self.layouts[0], self._objects, digest(self.config), named)

    def run(self, ends: Callable[[], bool]) -> None:
        """Run until `ends`, which is asked before each pass."""
        notifier, pipeline = Notifier(), self.pipeline
        try:
            realtime.trim()
            if pipeline.has_object:
                pipeline.warm_up()
            self.kept.restore()
            pipeline.freshness.came(self.around.monotonic() + START_S)  # no fault before
            with self.around.realtime(self.config.loop.priority) as self.realtime:
                notifier.ready()
                self.publisher.ready()
                self._loop(notifier, ends)
        finally:
            notifier.stopping()
            self.close()

    def close(self) -> None:
        """Stop the skin and free everything that is open."""
        self._opened.close()

    def _loop(self, notifier: Notifier, ends: Callable[[], bool]) -> None:
        ticker = Ticker(self.config.loop.rate_hz, self.publisher.estimate_s, self.around.monotonic)
        next_collect_s, ready = 0.0, ALL
        while not ends():
            scans, now = self.take(ready), ticker.begin()
            self.counters.overruns = ticker.missed
            self.tick(now, scans, ready)
            notifier.tick(now, self.publisher.status_line)
            if now >= next_collect_s:  # 0.1 ms, as what was there at the start is left out
                next_collect_s = now + COLLECT_S
                gc.collect()
            ready = self._wait(ticker)

    def _wait(self, ticker: Ticker) -> Ready:
        """Sleep until the next pass is due, or until frames, or a pose for a scan that waits, are
        there."""
        pipeline, sources = self.pipeline, self.inputs.sources
        if pipeline.has_waiting:
            self.link.ask_poses(also_next=True)
        is_busy = pipeline.has_waiting or pipeline.has_thought or any(s.is_busy for s in sources)
        until_s = ticker.until(busy=is_busy)
        hears = pipeline.has_waiting or self.inputs.array is not None
        door, devices = self.link.end if hears else None, [source.device for source in sources]
        ready = self.around.wait(devices, door, until_s)
        self.counters.unpolled += ready is ALL
        return ready

    def take(self, ready: Ready = ALL) -> list[Scan]:
        """Take what has arrived from the door, and from the devices; → scans.

        Where a device is `ready`, wait until its frames are a whole scan, or no more come, and
        until the door has answered: a pass for each of them would cost more than all work on the
        scan.
        """
        around = self.around
        began_ns, now_s = around.cpu_ns(), around.monotonic()
        (wall_s, stepped), sources = self.clock.read(), self.inputs.sources
        if stepped:
            self._record(ClockStep(wall_s, stepped))
            self.pipeline.clock_stepped(stepped)
            self.inputs.watch.clock_stepped()
        if ready.device and self.config.sensor_pose.endpoint:
            self.link.ask_poses(also_next=False)
        # poses, subscriptions and changes; while nothing needs them, only now and then
        if ready.door or self.pipeline.has_waiting or now_s >= self._next_look_s:
            self._look(now_s)
        scans: list[Scan] = []
        # where poses alone have come, the sources are left to the next pass
        if ready.device or not ready.door or self.inputs.array is not None:
            scans = polled(sources, now_s)
        until_s = now_s + ANSWER_S
        for _ in range(GATHERS if ready.device else 0):
            now_s, has_more = around.monotonic(), not scans and any(s.is_coming for s in sources)
            if self.link.is_asking and now_s < until_s:
                around.wait([], self.link.end, now_s + GATHER_S if has_more else until_s)
                self._look(around.monotonic())
            elif has_more:
                around.sleep(GATHER_S)
            else:
                break
            scans += polled(sources, around.monotonic())
        self._source_ns = around.cpu_ns() - began_ns
        return scans

    def tick(self, now_s: float, scans: Sequence[Scan] = (), ready: Ready = ALL) -> None:
        """One pass over the scans that were taken: pipeline and outputs. `now_s` is monotonic;
        `ready` names the inputs that had arrivals. Without any there is time for a search."""
        source_ns, self._source_ns = self._source_ns, 0
        around = self.around
        start_ns, cpu_ns = around.work_ns() - source_ns, around.cpu_ns()
        began_ns, source_us = cpu_ns - source_ns, source_ns / 1000.0
        pipeline, publisher, wall_s = self.pipeline, self.publisher, around.unix()
        if scans or pipeline.has_waiting:
            self._record(Pass(wall_s))
        for outcome in pipeline.advance(scans, wall_s):
            pipeline.freshness.came(now_s, outcome.link)
            start_ns = publisher.outcome(outcome, source_us, start_ns, now_s)
            source_us = 0.0  # the time counts for the first scan alone
            before_ns, cpu_ns = cpu_ns, around.cpu_ns()
            if outcome.is_used and outcome.estimate.injected:
                self._judge_touch(cpu_ns - before_ns)
        if not (scans or ready.device) and pipeline.has_thought:
            thought = pipeline.think()
            if thought is not None:
                publisher.thought(thought, now_s)
        self.kept.keep(now_s, wall_s)
        self.kept.remember(self.link, now_s)
        if publisher.send_due(now_s):
            t = around.unix()
            self.inputs.look(t)
            publisher.health(self.health(now_s, t), now_s)
        own_s = (around.cpu_ns() - began_ns) / 1e9
        self.counters.own_overruns += own_s * self.config.loop.rate_hz > 1.0

    def _look(self, now_s: float) -> None:
        self._next_look_s = now_s + LOOK_S
        for door in self.doors:
            door.look(now_s)

    def _record(self, item: Item, link: int = 0, t: float | None = None) -> None:
        if self.recorder is not None:
            self.recorder.take(item, link, t)

    def _judge_touch(self, took_ns: int) -> None:
        """Have fewer samples drawn where touches take more CPU time than there is between scans."""
        hubs = sum(stage.skin.hubs for stage in self.pipeline.stages)
        limit_ns = 1e6 * TOUCH_SHARE * self.config.source.period_ms / max(hubs, 1)
        if self.pipeline.samples.took(took_ns, limit_ns):
            log.warning(
                "touches take %.0f ms, and have %.0f: half the samples are drawn from now on",
                took_ns / 1e6,
                limit_ns / 1e6,
            )

    def on_pose(
        self, t: float, x: float, y: float, theta: float, came: float, link: int = 0
    ) -> None:
        """A pose of a link's sensor, which came at that Unix time."""
        self._record(SensorPose(t, x, y, theta), link, came)
        self.pipeline.stages[link].poses.add(t, x, y, theta, came)
        if not link:
            self.inputs.watch.add(t, came, is_far=max(abs(x), abs(y)) > FAR_M)

    def health(self, now_s: float, t: float) -> dict[str, Any]:
        """`/taxeld/health` from all parts of the daemon; `now_s` is monotonic, t Unix time. The
        table in `stream/values.md` chooses what is published of all that is counted."""
        pipeline, inputs, link = self.pipeline, self.inputs, self.link
        robot = link.report.robot
        calibration, counted = pipeline.stages[0].calibration, pipeline.health()
        counted["inputs"] |= {
            "poses_malformed": robot.malformed,
            "poses_rate_hz": inputs.watch.rate_hz,
            "poses_age_s": inputs.watch.age_s,
            "poses_offset_s": inputs.watch.offset_s,
        }
        parts = {
            "uptime_s": now_s - self.start_s,
            "loop": asdict(self.counters),
            "lat_us": {"total": self.publisher.percentiles()},
            "realtime": asdict(self.realtime),
            "source": self._counted(inputs.sources[0]),
            "calibration": {"age_s": t - calibration.t if calibration else -1.0},
            "door": {
                "starts": sum(door.starts for door in self.doors),
                **link.counts,
            },
            "recording": {
                "dropped": self.recorder.dropped if self.recorder else 0,
                "failed": self.recorder is not None and self.recorder.failed,
            },
            "kept": {"failed": self.kept.failed, "pending": self.kept.pending},
            **counted,
        }
        if len(self.layouts) > 1:
            whys = pipeline.freshness.of_links(now_s)
            # of links on one source, the first tells of it
            told = {each.links.numbers[0]: self._counted(each) for each in inputs.sources}
            parts["links"] = {
                name: {
                    "why": int(whys[k]),
                    "source": told.get(k, {}),
                    **pipeline.stages[k].health(),
                }
                for k, name in enumerate(self.config.names)
            }
        return messages.health(self.publisher.seq, t, parts)

    def _counted(self, source: Source) -> dict[str, Any]:
        found = source.decoder.stats() | asdict(source.counters)
        if source is self.inputs.array:
            found["malformed"] = self.link.report.array.malformed
        return found | {"bus": {fault: n for fault, n in source.bus.counts.items() if n}}

    def _tare(self) -> None:
        self.pipeline.tare()
        self.kept.forget(baselines=True)

    def _reset(self) -> str:
        """Forget all touches; → why that was not done."""
        self.kept.forget()
        return self.pipeline.reset()

    def _prior(self, **given: Any) -> str:
        """Take a prior; → why it is not taken."""
        pose, names = PosePrior(**given), list(self._objects)
        if pose.object and pose.object not in names:
            return f"no object {pose.object}; there are {', '.join(names)}"
        return self.pipeline.take_prior(pose, [names.index(pose.object)] if pose.object else None)
