"""The fixed-rate loop: it alone owns clocks, sockets and devices.

A tick takes what has arrived, runs the pipeline on it and publishes the estimate. Where a tick's
time does not carry all of that, samples are saved (ladder.py), then scans wait for the next one.
"""

import contextlib
import hashlib
import math
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import zmq

from taxeld import bundle, curve, layout, messages, realtime, state_file
from taxeld.clock import WallClock
from taxeld.config import Config
from taxeld.control import Control, ControlCounters
from taxeld.curve import Guard
from taxeld.estimate import Estimate, Status
from taxeld.latency import Latencies
from taxeld.notify import Notifier
from taxeld.pipeline import Outcome, Pipeline, is_valid
from taxeld.poses import PoseTrack
from taxeld.sources import ReplaySource, Source, open_source
from taxeld.state_file import StateFile
from taxeld.streams import PoseInput, Publisher
from taxeld.ticker import Ticker

STAGES = messages.STAGES[:-1]  # all but their total
PARTICLES_HZ = 20.0
HEALTH_S = 1.0


@dataclass(slots=True)
class LoopCounters:
    """Since start."""

    ticks: int = 0
    overruns: int = 0  # ticks that were missed
    own_overruns: int = 0  # ticks whose own CPU time was longer than their period
    scans: int = 0


class Daemon:
    """A configuration, running."""

    def __init__(self, config: Config) -> None:
        """Open everything a run needs.

        Raises:
            SetupError: something of it cannot be used.
        """
        self.config = config
        self.stopping = False
        self.counters = LoopCounters()
        self.layout = layout.load(config.skin.layout)
        scene = bundle.load(config.scene.bundle, self.layout, config.skin.full_scale_depth_m)
        self.pipeline = Pipeline(config, self.layout, scene, time.perf_counter_ns)
        self.latencies = Latencies(messages.STAGES)
        self.clock = WallClock()
        place, max_age_s = state_file.directory(config), config.skin.state_max_age_s
        self.kept = StateFile(place, self.pipeline.skin, max_age_s)
        self.kept.restore(time.time())
        budget = config.budget
        self._budget_us = {stage: 1e3 * getattr(budget, f"{stage}_ms") for stage in STAGES}
        self._over = dict.fromkeys(STAGES, 0)
        self._realtime = realtime.RealTime()
        self._publish_us = 0.0
        self._start_s = self._last_scan_s = time.monotonic()
        self._next_health_s = self._next_particles_s = 0.0
        self._estimate_sent: dict[str, Any] = {}
        self._health_sent: dict[str, Any] = {}
        digest = hashlib.sha256(repr(asdict(config)).encode()).hexdigest()[:16]
        self._info = messages.info(self.layout, scene.model.scene, scene.info, digest)
        with contextlib.ExitStack() as opened:
            opened.callback(self.kept.close)
            self.source: Source = open_source(config.source, self.layout)
            opened.callback(self.source.close)
            self._open_streams(opened)
            self._opened = opened.pop_all()

    def _open_streams(self, opened: contextlib.ExitStack) -> None:
        config = self.config
        context: zmq.Context[Any] = opened.enter_context(zmq.Context())
        self.guard = Guard(context, curve.load(config), config.curve)
        opened.callback(self.guard.stop)
        queue = round(config.loop.rate_hz)  # about a second
        self.publisher = Publisher(context, queue, self._info, self.guard)
        opened.callback(self.publisher.close)
        self.publisher.bind(config.publish.endpoints)
        self.pose_input: PoseInput | None = None
        if isinstance(self.pipeline.poses, PoseTrack):
            self.pose_input = PoseInput(context, self.pipeline.poses, self.guard)
            opened.callback(self.pose_input.close)
            self.pose_input.connect(config.sensor_pose.endpoint)
        self.control: Control | None = None
        if config.control.endpoint:
            handlers = {
                "status": self._on_status,
                "info": lambda: {"info": self._info},
                "tare": self._on_tare,
                "reset": self._on_reset,
            }
            self.control = Control(context, handlers, self.guard)
            opened.callback(self.control.close)
            self.control.bind(config.control.endpoint)

    def run(self) -> None:
        """Tick until `stopping`, or to the end of a replayed session."""
        notifier = Notifier()
        try:
            self.pipeline.warm_up()
            with realtime.thread(self.config.loop.priority) as self._realtime:
                notifier.ready()
                self._loop(notifier)
        finally:
            notifier.stopping()
            self.close()

    def _loop(self, notifier: Notifier) -> None:
        ticker = Ticker(self.config.loop.rate_hz)
        while not self.stopping:
            now = ticker.wait()
            self.counters.overruns = ticker.missed
            self.tick(now, ticker.left_s())
            notifier.tick(now, self._status_line)
            if isinstance(self.source, ReplaySource) and self.source.finished:
                break

    def tick(self, now_s: float, left_s: float = math.inf) -> None:
        """One pass: inputs, pipeline, outputs. `now_s` is monotonic; there is time for `left_s`."""
        start, cpu = time.perf_counter_ns(), time.thread_time_ns()
        self.counters.ticks += 1
        if self.config.budget.degrade:
            for_pipeline_s = left_s - self.config.budget.publish_ms / 1000.0
            self.pipeline.ladder.deadline_ns = start + 1e9 * for_pipeline_s
        wall_s, stepped = self.clock.read()
        if stepped:
            self._on_clock_step(stepped)
        if self.pose_input is not None:
            self.pose_input.poll()
        scans = self.source.poll(now_s)
        took = {"source": time.perf_counter_ns() - start, "skin": 0, "propose": 0, "filter": 0}
        outcome: Outcome | None = None
        # stamped while they were polled, so not older than now
        for outcome in self.pipeline.advance(scans, time.time() if scans else wall_s):
            took["skin"] += outcome.skin_ns
            took["propose"] += outcome.propose_ns
            took["filter"] += outcome.filter_ns
            self._last_scan_s = now_s
        self.counters.scans += len(scans)
        self.kept.keep(now_s)
        lat_us = {stage: ns / 1000.0 for stage, ns in took.items()}
        lat_us["publish"] = self._publish_us  # of the tick before: this one is not over yet
        lat_us["total"] = (time.perf_counter_ns() - start) / 1000.0 + self._publish_us
        published = time.perf_counter_ns()
        self._publish(outcome, lat_us, now_s)
        if outcome is not None:  # in this tick, though its scan may have waited since another
            self.latencies.add(lat_us)
        self.guard.poll()
        if self.control is not None:
            self.control.poll(now_s)
        self._publish_us = (time.perf_counter_ns() - published) / 1000.0
        for stage, us in self._budget_us.items():
            self._over[stage] += lat_us[stage] > us
        own_s = (time.thread_time_ns() - cpu) / 1e9
        self.counters.own_overruns += own_s * self.config.loop.rate_hz > 1.0

    def _on_clock_step(self, by: float) -> None:
        self.pipeline.clock_stepped(by)
        if isinstance(self.source, ReplaySource) and self.source.shift_s is not None:
            self.source.shift_s += by

    def close(self) -> None:
        """Stop the skin and free what is held."""
        self._opened.close()

    def _publish(self, outcome: Outcome | None, lat_us: dict[str, float], now_s: float) -> None:
        estimate = self._estimate(now_s)
        wall_s = time.time()
        self.publisher.greet(now_s, wall_s)
        seq = self.counters.ticks
        self._estimate_sent = messages.estimate(
            estimate,
            seq=seq,
            valid=is_valid(estimate),
            mono_ns=time.monotonic_ns(),
            age_us=(wall_s - estimate.t) * 1e6 if estimate.t else 0.0,
            overruns=self.counters.overruns,
            degraded=int(self.pipeline.ladder.step),
            lat_us=lat_us,
        )
        self.publisher.send(messages.ESTIMATE, self._estimate_sent, estimate.t)
        if outcome is not None and outcome.activation is not None:
            t = outcome.activation.t
            if self.publisher.wants(messages.TAXELS):
                self.publisher.send(messages.TAXELS, messages.taxels(outcome.activation, seq), t)
            due = estimate.contact and now_s >= self._next_particles_s
            if due and self.publisher.wants(messages.PARTICLES):
                self._next_particles_s = now_s + 1.0 / PARTICLES_HZ
                belief = self.pipeline.estimator.belief
                cloud = messages.particles(t, seq, belief.pose, belief.weight)
                self.publisher.send(messages.PARTICLES, cloud, t)
        if now_s >= self._next_health_s:
            self._next_health_s = now_s + HEALTH_S
            self._health_sent = self._health(seq, now_s, wall_s)
            self.publisher.send(messages.HEALTH, self._health_sent, wall_s)

    def _estimate(self, now_s: float) -> Estimate:
        """What the pipeline believes, stale where no scan has come."""
        estimate = self.pipeline.estimate
        if self._scans_are_stale(now_s):
            estimate = replace(estimate, status=Status.STALE)
        return estimate

    def _scans_are_stale(self, now_s: float) -> bool:
        return now_s - self._last_scan_s > self.config.loop.stale_s

    def _status_line(self, now_s: float) -> str:
        estimate = self._estimate(now_s)
        return (
            f"{estimate.status.name.lower()}, contacts {estimate.contacts}, "
            f"overruns {self.counters.overruns}"
        )

    def _health(self, seq: int, now_s: float, t: float) -> dict[str, Any]:
        pipeline = self.pipeline
        parts = {
            "uptime_s": now_s - self._start_s,
            "loop": self.counters,
            "over_budget": self._over,
            "degraded": pipeline.ladder.counters,
            "realtime": self._realtime,
            "source": {**self.source.wire.stats(), **asdict(self.source.counters)},
            "skin_state": self.kept.counters,
            "inputs": {
                **pipeline.input_counts(),
                "poses_malformed": self.pose_input.malformed if self.pose_input else 0,
                "scans_stale": self._scans_are_stale(now_s),
                "poses_stale": t - pipeline.poses.latest_t > pipeline.poses.max_age_s,
            },
            "control": self.control.counters if self.control else ControlCounters(),
            "keys_refused": self.guard.refused,
            "lat_us": self.latencies.percentiles(),
            **pipeline.health(),
        }
        return messages.health(seq, t, parts)

    def _on_status(self) -> dict[str, Any]:
        return {"estimate": self._estimate_sent, "health": self._health_sent}

    def _on_tare(self) -> dict[str, Any]:
        self.pipeline.tare()
        return {}

    def _on_reset(self) -> dict[str, Any]:
        self.pipeline.reset()
        return {}
