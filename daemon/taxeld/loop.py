"""The fixed-rate loop: it alone owns clocks, sockets and devices.

A tick takes what has arrived, runs the pipeline on it and publishes the estimate. Deadlines are
accumulated, so the rate does not drift; ticks that were missed are skipped and counted, never made
up for.
"""

import contextlib
import hashlib
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import zmq

from taxeld import bundle, layout, messages
from taxeld.config import Config
from taxeld.estimate import Estimate, Status
from taxeld.notify import Notifier
from taxeld.pipeline import Outcome, Pipeline, is_valid
from taxeld.poses import PoseTrack
from taxeld.sources import ReplaySource, Source, open_source
from taxeld.streams import Control, PoseInput, Publisher

PARTICLES_HZ = 20.0
HEALTH_S = 1.0
LATENCIES_KEPT = 2048  # ticks that percentiles are taken over


class Ticker:
    """Deadlines at a fixed rate on a monotonic clock."""

    def __init__(
        self,
        rate_hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period_s = 1.0 / rate_hz
        self.missed = 0
        self._clock = clock
        self._sleep = sleep
        self._deadline = clock() + self.period_s

    def wait(self) -> float:
        """Sleep to the next deadline; → the time. Deadlines that have passed are skipped."""
        now = self._clock()
        late = int((now - self._deadline) // self.period_s) + 1 if now > self._deadline else 0
        self.missed += late
        self._deadline += late * self.period_s
        self._sleep(max(0.0, self._deadline - now))
        self._deadline += self.period_s
        return self._clock()


class Latencies:
    """The last durations of each stage, for percentiles."""

    def __init__(self) -> None:
        self._us = np.zeros((len(messages.STAGES), LATENCIES_KEPT))
        self._n = 0

    def add(self, us: dict[str, float]) -> None:
        self._us[:, self._n % LATENCIES_KEPT] = [us[stage] for stage in messages.STAGES]
        self._n += 1

    def percentiles(self) -> dict[str, dict[str, float]]:
        if not self._n:
            return {}
        table = np.percentile(self._us[:, : min(self._n, LATENCIES_KEPT)], (50, 99, 100), axis=1)
        return {
            stage: {"p50": float(p50), "p99": float(p99), "max": float(top)}
            for stage, p50, p99, top in zip(messages.STAGES, *table, strict=True)
        }


@dataclass(slots=True)
class LoopCounters:
    """Since start."""

    ticks: int = 0
    overruns: int = 0
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
        self._latencies = Latencies()
        self._publish_us = 0.0
        self._last_scan_s = time.monotonic()
        self._next_health_s = self._next_particles_s = 0.0
        digest = hashlib.sha256(repr(asdict(config)).encode()).hexdigest()[:16]
        info = messages.info(self.layout, scene.model.scene, scene.info, digest)
        with contextlib.ExitStack() as opened:
            self.source: Source = open_source(config.source, self.layout)
            opened.callback(self.source.close)
            self._open_streams(opened, info)
            self._opened = opened.pop_all()

    def _open_streams(self, opened: contextlib.ExitStack, info: dict[str, Any]) -> None:
        config = self.config
        context: zmq.Context[Any] = opened.enter_context(zmq.Context())
        queue = round(config.loop.rate_hz)  # about a second
        self.publisher = Publisher(context, queue, info)
        opened.callback(self.publisher.close)
        self.publisher.bind(config.publish.endpoints)
        self.pose_input: PoseInput | None = None
        if isinstance(self.pipeline.poses, PoseTrack):
            self.pose_input = PoseInput(context, self.pipeline.poses)
            opened.callback(self.pose_input.close)
            self.pose_input.connect(config.sensor_pose.endpoint)
        self.control: Control | None = None
        if config.control.endpoint:
            handlers = {"status": self._on_status, "tare": self._on_tare, "reset": self._on_reset}
            self.control = Control(context, handlers)
            opened.callback(self.control.close)
            self.control.bind(config.control.endpoint)

    def run(self) -> None:
        """Tick until `stopping`, or to the end of a replayed session."""
        ticker = Ticker(self.config.loop.rate_hz)
        notifier = Notifier()
        notifier.ready()
        try:
            while not self.stopping:
                now = ticker.wait()
                self.counters.overruns = ticker.missed
                self.tick(now)
                notifier.tick(now, self._status_line)
                if isinstance(self.source, ReplaySource) and self.source.finished:
                    break
        finally:
            notifier.stopping()
            self.close()

    def tick(self, now_s: float) -> None:
        """One pass: inputs, pipeline, outputs. `now_s` is monotonic."""
        start = time.perf_counter_ns()
        self.counters.ticks += 1
        if self.pose_input is not None:
            self.pose_input.poll()
        scans = self.source.poll(now_s)
        took = {"source": time.perf_counter_ns() - start, "skin": 0, "propose": 0, "filter": 0}
        outcome: Outcome | None = None
        for scan in scans:
            outcome = self.pipeline.on_scan(scan)
            took["skin"] += outcome.skin_ns
            took["propose"] += outcome.propose_ns
            took["filter"] += outcome.filter_ns
            self._last_scan_s = now_s
            self.counters.scans += 1
        lat_us = {stage: ns / 1000.0 for stage, ns in took.items()}
        lat_us["publish"] = self._publish_us  # of the tick before: this one is not over yet
        lat_us["total"] = (time.perf_counter_ns() - start) / 1000.0 + self._publish_us
        published = time.perf_counter_ns()
        self._publish(outcome, lat_us, now_s)
        if scans:
            self._latencies.add(lat_us)
        if self.control is not None:
            self.control.poll()
        self._publish_us = (time.perf_counter_ns() - published) / 1000.0

    def close(self) -> None:
        """Stop the skin and free what is held."""
        self._opened.close()

    def _publish(self, outcome: Outcome | None, lat_us: dict[str, float], now_s: float) -> None:
        estimate = self._estimate(now_s)
        wall_s = time.time()
        self.publisher.greet(wall_s)
        seq = self.counters.ticks
        message = messages.estimate(
            estimate,
            seq=seq,
            valid=is_valid(estimate),
            mono_ns=time.monotonic_ns(),
            age_us=(wall_s - estimate.t) * 1e6 if estimate.t else 0.0,
            overruns=self.counters.overruns,
            lat_us=lat_us,
        )
        self.publisher.send(messages.ESTIMATE, message, estimate.t)
        if outcome is not None and outcome.activation is not None:
            t = outcome.activation.t
            self.publisher.send(messages.TAXELS, messages.taxels(outcome.activation, seq), t)
            if estimate.contact and now_s >= self._next_particles_s:
                self._next_particles_s = now_s + 1.0 / PARTICLES_HZ
                belief = self.pipeline.estimator.belief
                cloud = messages.particles(t, seq, belief.pose, belief.weight)
                self.publisher.send(messages.PARTICLES, cloud, t)
        if now_s >= self._next_health_s:
            self._next_health_s = now_s + HEALTH_S
            self.publisher.send(messages.HEALTH, self._health(seq, wall_s), wall_s)

    def _estimate(self, now_s: float) -> Estimate:
        """What the pipeline believes, stale where no scan has come."""
        estimate = self.pipeline.estimate
        if now_s - self._last_scan_s > self.config.loop.stale_s:
            estimate = replace(estimate, status=Status.STALE)
        return estimate

    def _status_line(self, now_s: float) -> str:
        estimate = self._estimate(now_s)
        return (
            f"{estimate.status.name.lower()}, contacts {estimate.contacts}, "
            f"overruns {self.counters.overruns}"
        )

    def _health(self, seq: int, t: float) -> dict[str, Any]:
        pipeline = self.pipeline
        live = pipeline.skin.live
        parts = {
            "loop": self.counters,
            "source": {**self.source.wire.stats(), **asdict(self.source.counters)},
            "skin": pipeline.skin.counters,
            "estimator": pipeline.estimator.counters,
            "inputs": {
                "scans_without_pose": pipeline.without_pose,
                "poses_rejected": pipeline.poses.rejected,
                "poses_malformed": self.pose_input.malformed if self.pose_input else 0,
                "unsent": self.publisher.dropped,
            },
            "lat_us": self._latencies.percentiles(),
            "dead_taxels": [] if live is None else np.flatnonzero(~live).tolist(),
        }
        return messages.health(seq, t, parts)

    def _on_status(self, _: dict[str, Any]) -> dict[str, Any]:
        estimate = self.pipeline.estimate
        summary = messages.estimate(estimate, seq=self.counters.ticks, valid=is_valid(estimate))
        return {"estimate": summary, "health": self._health(self.counters.ticks, time.time())}

    def _on_tare(self, _: dict[str, Any]) -> dict[str, Any]:
        self.pipeline.tare()
        return {}

    def _on_reset(self, _: dict[str, Any]) -> dict[str, Any]:
        self.pipeline.reset()
        return {}
