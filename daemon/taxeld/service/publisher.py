"""What a run publishes: each result of its pipeline, and by the clock what is due without one."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from taxeld.arrays import Poses
from taxeld.estimator.estimate import Estimate
from taxeld.model.observation import Activation
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome
from taxeld.proposals import bundle
from taxeld.service.inputs import Inputs
from taxeld.service.notices import Notices
from taxeld.service.prepare import Prepared
from taxeld.service.surroundings import Surroundings
from taxeld.skin.patches import Patches
from taxeld.stream import messages, topics
from taxeld.stream.link import Link

PARTICLES_HZ = 20.0
HEALTH_S = 1.0
LAST = 4096  # scans of whose durations there are percentiles: minutes


@dataclass(slots=True)
class LoopCounters:
    """Counters of the loop, since start."""

    overruns: int = 0  # periods that passed while the loop worked, or while the machine held it up
    own_overruns: int = 0  # passes whose own CPU time was longer than a period
    unpolled: int = 0  # waits in which the kernel could not say what had arrived


class Publisher:
    """Sends messages to subscribers, answers `status` and logs what has changed."""

    def __init__(
        self,
        made: Prepared,
        inputs: Inputs,
        link: Link,
        counters: LoopCounters,
        around: Surroundings,
    ) -> None:
        self.seq = 0  # number of the last estimate
        self.scans = 0  # that were worked on to their end
        config = made.config
        self.estimate_s = 1.0 / config.publish.rate_hz if made.bundles else HEALTH_S
        self._config, self._pipeline, self._link = config, made.pipeline, link
        self._inputs, self._counters, self._around = inputs, counters, around
        self._names = tuple(bundle.scenes(made.bundles))
        self._patches = [
            Patches(layout, one.skin.full_scale_depth_m)
            for one, layout in zip(config.each, made.layouts, strict=True)
        ]
        self._notices = Notices(made, self._names)
        self._total_us: deque[float] = deque(maxlen=LAST)  # durations of scans
        self._longest_us = self._publish_us = 0.0  # since start; of sending the last estimate
        self._next_particles_s = self._next_estimate_s = self._next_health_s = 0.0
        self._published: Estimate | None = None  # the last
        self._why = Why.STARTING  # why that one is not valid

    def ready(self) -> None:
        """Log that all is open and warm."""
        self._notices.ready(self._inputs.sources[0].waits_for)

    def outcome(self, outcome: Outcome, source_us: float, start_ns: int, now_s: float) -> int:
        """Publish the outcome of a scan, on which work began at `start_ns`; → the time now, on
        the same clock."""
        begin_ns, link, t = self._around.work_ns(), self._link, outcome.estimate.t
        stage, activation = self._pipeline.stages[outcome.link], outcome.activation
        # `publish` is the previous message's: this one is not sent yet
        total_us = (begin_ns - start_ns) / 1000.0 + self._publish_us
        lat_us = {"source": source_us, "publish": self._publish_us, "total": total_us}
        if (outcome.is_used and self._names) or self._is_news(outcome.estimate):
            self._send_estimate(_stages_us(outcome) | lat_us, now_s)
        is_read = stage.fresh.last is not Why.SCANS_MISTIMED
        if self._config.publish.counts and is_read and link.wants(topics.COUNTS):
            told = messages.counts(t, stage.skin.counts, self.seq, outcome.link)
            link.send(topics.COUNTS, told, t)
        if activation is not None:
            self._send_activation(activation, outcome.sensor, now_s, outcome.link)
        self._took(total_us)
        end_ns = self._around.work_ns()
        self._publish_us = (end_ns - begin_ns) / 1000.0
        return end_ns

    def _took(self, total_us: float) -> None:
        self.scans += 1
        self._total_us.append(total_us)
        self._longest_us = max(self._longest_us, total_us)

    def percentiles(self) -> dict[str, float]:
        """Durations of the last scans [µs], and the longest since start; zeros before any."""
        p50, p99 = np.percentile(self._total_us or [0.0], (50, 99)).tolist()
        return {"p50": p50, "p99": p99, "max": self._longest_us}

    def thought(self, outcome: Outcome, now_s: float) -> None:
        """Publish the estimate again, which a search has changed."""
        self._send_estimate(_stages_us(outcome), now_s)

    def send_due(self, now_s: float) -> bool:
        """Publish without a scan: an estimate whose status has changed or whose time has come,
        unless a scan that waits brings the next; → whether health is due as well."""
        estimate = self._pipeline.estimate_at(now_s)
        wait_s = self._config.sensor_pose.wait_s if self._pipeline.has_waiting else 0.0
        if self._is_news(estimate) or now_s >= self._next_estimate_s + wait_s:
            self._send_estimate(dict.fromkeys(messages.STAGES, 0.0), now_s)
        return now_s >= self._next_health_s

    def health(self, health: dict[str, Any], now_s: float) -> None:
        """Publish the message of a second, and log what has changed."""
        self._next_health_s = now_s + HEALTH_S
        self._link.send(topics.HEALTH, health, health["t"])
        self._notices.inputs(self._inputs.watch.fault, now_s)
        self._link.tell(self.state())

    def status_line(self, now_s: float) -> str:
        """For the service manager."""
        if all(source.waits_for for source in self._inputs.sources):
            return f"waiting, {self._inputs.sources[0].waits_for}"
        estimate = self._pipeline.estimate_at(now_s)
        sure = "not valid" if self._why else f"p {estimate.p:.1%}"
        line = f"{estimate.status.name.lower()}, {sure}"
        return f"{line}, contacts {estimate.contacts}, overruns {self._counters.overruns}"

    def state(self) -> dict[str, Any]:
        """The part of the answer to `status` that no message has."""
        sensor_pose = {
            "endpoint": self._config.sensor_pose.endpoint,
            "fault": self._inputs.watch.fault,
        }
        waits_for, why = self._inputs.waits_for, self._reason()
        return {"waits_for": waits_for, "why": why, "sensor_pose": sensor_pose}

    def _reason(self) -> str:
        """Why the estimate published last is not valid, and the cure; empty where it is."""
        facts = {Why.NO_SCAN: self._inputs.waits_for, Why.NO_POSE: self._inputs.watch.fault}
        estimate, fact = self._published or self._pipeline.estimate, facts.get(self._why, "")
        return self._pipeline.freshness.sentence(self._why, estimate, fact)

    def _is_news(self, estimate: Estimate) -> bool:
        """Whether its status, or the belief in an object, is another than was published."""
        last = self._published
        if last is None or last.status is not estimate.status:
            return True
        return last.t != estimate.t and bool(self._names)

    def _send_estimate(self, lat_us: dict[str, float], now_s: float) -> None:
        self.seq += 1
        wall_s, freshness = self._around.unix(), self._pipeline.freshness
        estimate = self._published = self._pipeline.estimate_at(now_s)
        self._next_estimate_s = now_s + self.estimate_s
        before, self._why = self._why, freshness.why(estimate, now_s)
        if self._why is not before:
            self._link.tell(self.state())
        self._notices.estimate(estimate, self._why, self._reason(), now_s)
        told = messages.estimate(
            estimate,
            names=self._names,
            seq=self.seq,
            why=self._why,
            mono_ns=round(1e9 * self._around.monotonic()),
            age_us=(wall_s - estimate.t) * 1e6 if estimate.t else 0.0,
            overruns=self._counters.overruns,
            degraded=int(self._pipeline.samples.degraded),
            lat_us=lat_us,
            links=freshness.of_links(now_s),
        )
        self._link.send(topics.ESTIMATE, told, estimate.t)

    def _send_activation(
        self, activation: Activation, sensor: Poses | None, now_s: float, number: int
    ) -> None:
        t, link = activation.t, self._link
        if link.wants(topics.TAXELS):
            link.send(topics.TAXELS, messages.taxels(activation, sensor, self.seq, number), t)
        patches, skin = self._patches[number], self._pipeline.stages[number].skin
        if link.wants(topics.CONTACTS) and (skin.touched or patches.now):
            patches.on_scan(activation.z)
            told = messages.contacts(t, patches, sensor, self.seq, number)
            link.send(topics.CONTACTS, told, t)
        is_due = now_s >= self._next_particles_s and link.wants(topics.PARTICLES)
        if is_due and self._names and self._pipeline.estimate.contact:
            self._next_particles_s = now_s + 1.0 / PARTICLES_HZ
            belief = self._pipeline.estimator.belief.particles
            cloud = messages.particles(t, self.seq, belief.pose, belief.weight)
            link.send(topics.PARTICLES, cloud, t)


def _stages_us(outcome: Outcome) -> dict[str, float]:
    """The time of each stage of the work on an outcome, the others 0."""
    return dict.fromkeys(messages.STAGES, 0.0) | {
        "skin": outcome.skin_ns / 1000.0,
        "propose": outcome.propose_ns / 1000.0,
        "filter": outcome.filter_ns / 1000.0,
    }
