"""The loop: it alone owns clocks, sockets and devices.

It sleeps until something arrives, or until its clock says so. A pass takes the arrivals, works on
each scan to its end and publishes the results. A pass that finds no arrivals takes one second
opinion on what was felt, if the pipeline has one to offer.
"""

import contextlib
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.pipeline.warm_up import warm_up
from taxeld.prior import PosePrior
from taxeld.proposals import bundle
from taxeld.service import health, realtime
from taxeld.service.clock import WallClock
from taxeld.service.doorkeeper import Doorkeeper, settings_of
from taxeld.service.inputs import Inputs
from taxeld.service.kept import Store
from taxeld.service.notify import Notifier
from taxeld.service.prepare import digest, prepared
from taxeld.service.publisher import LoopCounters, Publisher
from taxeld.service.ticker import ALL, Ready, Ticker, wait
from taxeld.source.recorder import Recorder
from taxeld.stream import messages
from taxeld.stream.link import Link
from taxeld_protocol.decoder import Scan

TOUCH_SHARE = 0.8  # share of the time until the next scan that a touch may take
START_S = 2.0  # time that a skin may take to start, before the lack of scans is a fault
LOOK_S = 0.05  # time between looks at the door while no scan waits for a pose

log = logging.getLogger(__name__)


class Daemon:
    """A configuration in operation."""

    def __init__(self, config: Config, recorder: Recorder | None = None) -> None:
        """Open everything that a run needs; `recorder` gets the input from skin and robot.

        Raises:
            SetupError: a part of it cannot be used.
        """
        self.stopping = False
        with contextlib.ExitStack() as opened:
            # the door's process starts while the slow parts here load
            door = Doorkeeper(settings_of(config))
            self.door = opened.enter_context(contextlib.closing(door))
            made = prepared(config, recorder)
            self.config, self.layouts, self.pipeline = made.config, made.layouts, made.pipeline
            self._objects = bundle.scenes(made.bundles)
            self._models = [one.model for one in made.bundles]
            self.counters, self.clock = LoopCounters(), WallClock()
            self.realtime, self.recorder = realtime.RealTime(), recorder
            self.start_s = time.monotonic()
            self.pipeline.freshness.came(self.start_s)  # counted as if a scan had come at the start
            self._next_look_s = 0.0
            self.inputs = Inputs(made)
            self.kept = Store(self.config, self.pipeline)
            changes = {"tare": self.pipeline.tare, "reset": self._reset, "prior": self._prior}
            self.link = Link(self._info(), self.inputs.on_pose, changes)
            self.publisher = Publisher(made, self.inputs, self.link, self.counters)
            opened.callback(self.link.detach)
            opened.callback(self.kept.close)
            if recorder:
                opened.enter_context(recorder)
            self.inputs.open(self.link, recorder, opened)
            self.door.wait(self.link)
            self._opened = opened.pop_all()

    def _info(self) -> dict[str, object]:
        several_links = len(self.layouts) > 1
        named = dict(zip(self.config.names, self.layouts, strict=True)) if several_links else {}
        return messages.info(self.layouts[0], self._objects, digest(self.config), named)

    def stop(self) -> None:
        """End `run` after this pass."""
        self.stopping = True

    def run(self, between: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`; `between` is called between two passes.

        Raises:
            SetupError: the source reports that no scan can ever be used.
        """
        notifier, pipeline = Notifier(), self.pipeline
        try:
            realtime.trim()
            if self._models:
                warm_up(self.config, self._models, pipeline.samples)
                self.kept.restore_belief()
            pipeline.freshness.came(time.monotonic() + START_S)  # no fault before
            with realtime.thread(self.config.loop.priority) as self.realtime:
                notifier.ready()
                self.publisher.ready()
                self._loop(notifier, between)
        finally:
            notifier.stopping()
            self.close()

    def close(self) -> None:
        """Stop the skin and free everything that is open."""
        self._opened.close()

    def _loop(self, notifier: Notifier, between: Callable[[], None]) -> None:
        ticker = Ticker(self.config.loop.rate_hz, self.publisher.estimate_s)
        collector, sources = realtime.Collector(), self.inputs.sources
        ready = ALL
        while not self.stopping:
            now = ticker.begin()
            self.counters.overruns = ticker.missed
            self.tick(now, ready)
            notifier.tick(now, self.publisher.status_line)
            collector.tick(now, self.inputs.openings, pressed=self.pipeline.is_touched)
            between()
            fault = next((source.fault for source in sources if source.fault), "")
            if fault:
                raise SetupError(fault)
            ready = self._wait(ticker)

    def _wait(self, ticker: Ticker) -> Ready:
        pipeline, sources = self.pipeline, self.inputs.sources
        if pipeline.has_waiting:
            self.link.ask_poses(also_next=True)
        is_busy = pipeline.has_waiting or pipeline.has_thought or any(s.is_busy for s in sources)
        until_s = ticker.until(busy=is_busy)
        hears = pipeline.has_waiting or self.inputs.come_by_door
        door, devices = self.link.end if hears else None, [source.device for source in sources]
        ready = wait(devices, door, until_s)
        if ready.device:
            self.link.ask_poses(also_next=False)
            self.inputs.gather()
        return ready

    def tick(self, now_s: float, ready: Ready = ALL) -> None:
        """One pass: inputs, pipeline, outputs. `now_s` is monotonic; `ready` names the inputs that
        may have arrivals. Without any there is time for a second opinion."""
        start, cpu = time.perf_counter_ns(), time.thread_time_ns()
        wall_s, stepped = self.clock.read()
        if stepped:
            self.pipeline.clock_stepped(stepped)
            self.inputs.watch.clock_stepped()
        if self.inputs.come_by_door:
            self._look_at_door(now_s, asked=ready.door)
        scans = self.inputs.poll(now_s)
        has_scans = any(scans)
        came = (ready.door or has_scans) and not self.inputs.come_by_door  # else it has looked
        self._look_at_door(now_s, asked=came or self.pipeline.has_waiting)
        self._work(scans, start, wall_s, now_s)
        if not (has_scans or ready.device) and self.pipeline.has_thought:
            outcome = self.pipeline.think()
            if outcome is not None:
                self.publisher.thought(outcome, now_s)
        self.kept.keep(now_s, wall_s)
        if self.publisher.send_due(now_s):
            self._send_health(now_s)
        own_s = (time.thread_time_ns() - cpu) / 1e9
        self.counters.own_overruns += own_s * self.config.loop.rate_hz > 1.0

    def _work(
        self, scans: Sequence[list[Scan]], start_ns: int, wall_s: float, now_s: float
    ) -> None:
        """Work on each scan of each link to its end, and publish its outcome. `start_ns`: when the
        pass began, on `perf_counter_ns`."""
        source_us = (time.perf_counter_ns() - start_ns) / 1000.0
        cpu = time.thread_time_ns()
        # scans are stamped while polled, so the time must be read after that
        now = time.time() if any(scans) else wall_s
        for outcome in self.pipeline.advance(scans[0], now, *scans[1:]):
            self.pipeline.freshness.came(now_s, outcome.link)
            start_ns = self.publisher.outcome(outcome, source_us, start_ns, now_s)
            source_us = 0.0  # the time counts for the first scan alone
            before, cpu = cpu, time.thread_time_ns()
            if outcome.is_used and outcome.estimate.injected:
                self._judge_touch(cpu - before)

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

    def _look_at_door(self, now_s: float, *, asked: bool) -> None:
        """Take poses, subscriptions and changes; while no scan needs poses, only now and then."""
        if asked or now_s >= self._next_look_s:
            self._next_look_s = now_s + LOOK_S
            self.door.look(self.link, now_s)

    def _send_health(self, now_s: float) -> None:
        array = self.link.report.array
        for source in self.inputs.sources:
            source.heed(connected=array.connected, malformed=array.malformed, reason=array.reason)
        told = health.of(self, self.publisher.seq, now_s, time.time())
        self.publisher.health(told, now_s)

    def _reset(self) -> str:
        """Forget all touches; → why that was not done."""
        try:
            return self.pipeline.reset()
        finally:  # what cannot be forgotten here is not to come back with the next start
            self.kept.forget_belief()

    def _prior(self, **given: Any) -> str:
        """Take a prior; → why it is not taken."""
        pose = PosePrior(**given)
        numbers = [k for k, name in enumerate(self._objects) if name == pose.object]
        if pose.object and not numbers:
            return f"no object {pose.object}; there are {', '.join(self._objects)}"
        return self.pipeline.tell(pose, numbers or None)
