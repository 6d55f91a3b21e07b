"""The loop: it alone owns clocks, sockets and devices.

It sleeps until something arrives, or until its clock says so. A pass takes the arrivals, works on
each scan to its end and publishes the results. A pass that finds no arrivals takes one second
opinion on what was felt, if the estimator has one to offer.
"""

import contextlib
import hashlib
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from taxeld.advice.advice import Advice
from taxeld.arrays import Poses
from taxeld.config import links
from taxeld.config.tables import Config
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate
from taxeld.layout import read as layouts
from taxeld.layout.layout import Layout
from taxeld.model.activation import Activation
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.outcome import Outcome
from taxeld.pipeline.pipeline import Pipeline
from taxeld.pipeline.pose_watch import PoseFigures, PoseWatch
from taxeld.pipeline.poses import OnPose
from taxeld.pipeline.skin_server import SkinServer
from taxeld.pipeline.warm_up import warm_up
from taxeld.proposals import choice, several
from taxeld.service import calibration_file, health, realtime, state_file
from taxeld.service.belief_file import BeliefFile
from taxeld.service.clock import WallClock
from taxeld.service.doorkeeper import Doorkeeper, settings_of
from taxeld.service.latency import Latencies
from taxeld.service.notices import Notices
from taxeld.service.notify import Notifier
from taxeld.service.state_file import StateFile
from taxeld.service.ticker import ALL, Ready, Ticker, wait
from taxeld.skin.patches import Patches
from taxeld.source import session
from taxeld.source.recorder import Recorder
from taxeld.source.source import Source
from taxeld.source.sources import Bus, check_uids, joint, open_source
from taxeld.stream import messages
from taxeld.stream.link import Link
from taxeld.told import ToldPose
from taxeld_protocol.decoder import Scan

PARTICLES_HZ = 20.0
ADVICE_S = 0.2  # time between two messages of the same advice
HEALTH_S = 1.0
GATHER_S = 0.0002  # silence after a whole scan: its frames follow each other more closely
GATHERS = 20  # looks at the device for further frames, GATHER_S apart
TOUCH_SHARE = 0.8  # share of the time until the next scan that a touch may take
START_S = 2.0  # time that a skin may take to start, before the lack of scans is a fault
PRIOR_S = 2.0  # a prior whose time is farther off is not taken
LOOK_S = 0.05  # time between looks at the door while no scan waits for a pose

log = logging.getLogger(__name__)


@dataclass(slots=True)
class LoopCounters:
    """Counters of the loop, since start."""

    ticks: int = 0  # passes of the loop
    overruns: int = 0  # periods that passed while the loop worked, or while the machine held it up
    own_overruns: int = 0  # passes whose own CPU time was longer than a period
    scans: int = 0


class Daemon:
    """A configuration in operation."""

    def __init__(self, config: Config, recorder: Recorder | None = None) -> None:
        """Open everything that a run needs; `recorder` gets the input from skin and robot.

        Raises:
            SetupError: a part of it cannot be used.
        """
        recorded, is_replay = Path(config.source.path), config.source.kind == "replay"
        self._replays_poses = is_replay and session.has_poses(recorded)
        if self._replays_poses:  # a recorded robot replaces the configured endpoint
            where = replace(config.sensor_pose, endpoint=config.source.path)
            config = replace(config, sensor_pose=where)
        self.config = config
        self.stopping = False
        robot = "" if self._replays_poses else config.sensor_pose.endpoint
        with contextlib.ExitStack() as opened:
            # the door's process starts while the slow parts here load
            self.door = opened.enter_context(
                contextlib.closing(Doorkeeper(settings_of(config, robot)))
            )
            self._prepare(config, recorder)
            self._open(opened, config)
            self._opened = opened.pop_all()

    def _prepare(self, config: Config, recorder: Recorder | None) -> None:
        """Build everything except devices and files."""
        self.counters = LoopCounters()
        self.of_links = [config.of_link(k) for k in range(len(config.names))]
        self.layouts = [layouts.load(one.skin.layout) for one in self.of_links]
        self.layout, *further = self.layouts
        bundles = []
        if config.scene.names:
            depth_m = config.skin.full_scale_depth_m
            bundles = several.load(config.scene, self.layout, depth_m, further)
        config = self.config = several.sized(config, [one.manifest for one in bundles])
        self.patches = [
            Patches(layout, one.skin.full_scale_depth_m)
            for one, layout in zip(self.of_links, self.layouts, strict=True)
        ]
        calibration = [
            calibration_file.of(one, layout)
            for one, layout in zip(self.of_links, self.layouts, strict=True)
        ]
        clock, on_pose = time.perf_counter_ns, recorder.pose if recorder else None
        on_poses = self._recorded_beside(recorder)
        self._more = [one.model for one in bundles[1:]]
        if bundles:
            self.pipeline = Pipeline(
                config,
                bundles[0].model,
                choice.ladder(bundles, config, clock),
                on_pose,
                calibration,
                more=self._more,
                on_poses=on_poses,
            )
        else:
            self.pipeline = SkinServer(
                config, self.layouts, clock, on_pose, calibration, on_poses=on_poses
            )
        self.pipeline.thinks_at_once = False
        self.recorder = recorder
        self.latencies = Latencies(messages.STAGES)
        self.clock = WallClock()
        self._prepare_kept(config)
        self.realtime = realtime.RealTime()
        self._publish_us = 0.0  # time of sending the last estimate [µs]
        self._seq = 0
        self.start_s = time.monotonic()
        self.pipeline.freshness.came(self.start_s)  # counted as if a scan had come at the start
        self._next_health_s = self._next_particles_s = self._next_estimate_s = 0.0
        self._estimate_s = 1.0 / config.publish.rate_hz if bundles else HEALTH_S
        self._next_look_s = self._next_advice_s = 0.0
        self._advised: Advice | None = None  # the advice published last
        self._told: Estimate | None = None  # the estimate published last
        self._why = Why.STARTING  # why that one is not valid
        scenes = several.scenes(bundles)
        self._names = tuple(scenes)
        paths = [one.path for one in bundles]
        self._notices = Notices(self._names, self.pipeline.ladder.name, paths)
        self._estimate_sent: dict[str, Any] = {}
        self._health_sent: dict[str, Any] = {}
        self._info = messages.info(self.layout, scenes, _digest(config), self._named)
        self._watches = [_watch_of(one) for one in self.of_links]
        changes = {"tare": self.pipeline.tare, "reset": self._reset}
        self.link = Link(self._info, self._on_pose, changes)
        self.link.on_prior = self._on_prior
        for k in range(1, len(self.layouts)):
            self.link.on_poses[k] = partial(self._on_pose, link=k)

    def _prepare_kept(self, config: Config) -> None:
        """Take what the skins learned before, and see what is kept of the belief."""
        self.kept = [
            StateFile(
                state_file.directory(one, config.names[k] if k else ""),
                self.pipeline.stages[k].skin,
                partial(self.pipeline.skin_state, k),
            )
            for k, one in enumerate(self.of_links)
        ]
        for kept in self.kept:
            kept.restore(time.time())
        self.belief: BeliefFile | None = None
        if self.pipeline.has_object:
            self.belief = BeliefFile(state_file.directory(config), self.pipeline.estimator)

    def _open(self, opened: contextlib.ExitStack, config: Config) -> None:
        opened.callback(self.link.detach)
        for kept in self.kept:
            opened.callback(kept.close)
        if self.belief is not None:
            belief = self.belief
            opened.callback(lambda: belief.close(time.time()))
        if self.recorder:
            opened.enter_context(self.recorder)
        self.buses = list[Bus]()
        for bus, numbers in links.buses(config):
            own = [self.layouts[k] for k in numbers]
            check_uids([config.names[k] for k in numbers], own)
            suis = {int(uid) >> 4 for layout in own for uid in layout.uid}
            for k in numbers:
                wiring = self.pipeline.stages[k].skin.wiring
                wiring.neighbours = suis - set(wiring.suis)
            source = open_source(
                bus, joint(own), self._recorder_of(numbers[0]), self.pipeline.poses.add, wait=True
            )
            opened.callback(source.close)
            if source.comes_by_door:
                self.link.on_array = source.hear
            self.buses.append(Bus(source, numbers, own))
        self.source: Source = self.buses[0].source  # of the first link
        self.sources = [bus.source for bus in self.buses]
        self.door.wait(self.link)

    def stop(self) -> None:
        """End `run` after this pass."""
        self.stopping = True

    def run(self, between: Callable[[], None] = lambda: None) -> None:
        """Run until `stop`, or to the end of a replayed session; `between` is called between two
        passes.

        Raises:
            SetupError: the source reports that no scan can ever be used.
        """
        notifier = Notifier()
        try:
            realtime.trim()
            if self.belief is not None:
                self._warm_up()
                self.pipeline.restore(self.belief.read(time.time()))
            self.pipeline.freshness.came(time.monotonic() + START_S)  # no fault before
            with realtime.thread(self.config.loop.priority) as self.realtime:
                notifier.ready()
                self._notices.ready(self.config, self._info, self.source.waits_for)
                self._loop(notifier, between)
        finally:
            notifier.stopping()
            self.close()

    def _warm_up(self) -> None:
        model, ladder = self.pipeline.estimator.model, self.pipeline.ladder
        limit_ns = self._touch_ns(hubs=1)
        warm_up(model, ladder, self.config.filter, time.thread_time_ns, limit_ns, self._more)

    def _loop(self, notifier: Notifier, between: Callable[[], None]) -> None:
        ticker = Ticker(self.config.loop.rate_hz, self._estimate_s)
        collector = realtime.Collector()
        ready = ALL
        while not self.stopping:
            now = ticker.begin()
            self.counters.overruns = ticker.missed
            self.tick(now, ready)
            notifier.tick(now, self._status_line)
            opened = sum(s.counters.unopened + s.counters.reopened for s in self.sources)
            collector.tick(now, opened, pressed=self._is_pressed)
            between()
            fault = next((source.fault for source in self.sources if source.fault), "")
            if fault:
                raise SetupError(fault)
            if all(source.finished for source in self.sources) and not self.pipeline.has_waiting:
                break
            ready = self._wait(ticker)

    def _wait(self, ticker: Ticker) -> Ready:
        """Wait until the next pass is due, by an arrival or by the clock."""
        pipeline, sources = self.pipeline, self.sources
        if pipeline.has_waiting:
            self.link.ask_poses(also_next=True)
        is_busy = pipeline.has_waiting or pipeline.has_thought or any(s.is_busy for s in sources)
        until_s = ticker.until(busy=is_busy)
        hears = pipeline.has_waiting or self._by_door
        door, further = self.link.end if hears else None, [s.device for s in sources[1:]]
        ready = wait(sources[0].device, door, until_s, further)
        if ready.device:
            self.link.ask_poses(also_next=False)
            self._gather()
        return ready

    def _gather(self) -> None:
        """Wait until the frames that come are a whole scan: a pass for each of them would cost more
        than all work on the scan."""
        held = 0
        for _ in range(GATHERS):
            before, held = held, sum(source.gather() for source in self.sources)
            if held == before:
                return
            time.sleep(GATHER_S)

    def tick(self, now_s: float, ready: Ready = ALL) -> None:
        """One pass: inputs, pipeline, outputs. `now_s` is monotonic; `ready` names the inputs that
        may have arrivals. Without any there is time for a second opinion."""
        start, cpu = time.perf_counter_ns(), time.thread_time_ns()
        self.counters.ticks += 1
        wall_s, stepped = self.clock.read()
        if stepped:
            self.pipeline.clock_stepped(stepped)
            for source in self.sources:
                source.clock_stepped(stepped)
            for watch in self._watches:
                watch.clock_stepped()
        if self._by_door:
            self._look_at_door(now_s, asked=ready.door)
        scans, *further = self._poll(now_s)
        has_scans = any((scans, *further))
        came = (ready.door or has_scans) and not self._by_door  # else it has looked
        self._look_at_door(now_s, asked=came or self.pipeline.has_waiting)
        self._work(scans, start, wall_s, now_s, further)
        if not (has_scans or ready.device) and self.pipeline.has_thought:
            self._think(now_s)
        for kept in self.kept:
            kept.keep(now_s)
        if self.belief is not None:
            self.belief.keep(now_s, wall_s)
        self._publish_due(now_s)
        own_s = (time.thread_time_ns() - cpu) / 1e9
        self.counters.own_overruns += own_s * self.config.loop.rate_hz > 1.0

    def _poll(self, now_s: float) -> list[list[Scan]]:
        """The scans that have come, of each link."""
        came: list[list[Scan]] = [[] for _ in self.layouts]
        for bus in self.buses:
            scans = bus.source.poll(now_s)
            self.counters.scans += len(scans)
            for scan in scans:
                for link in bus.links_of(scan):
                    came[link].append(scan)
        return came

    @property
    def _by_door(self) -> bool:
        """Whether scans come by the door, as those of an array do."""
        return any(source.comes_by_door for source in self.sources)

    @property
    def _is_pressed(self) -> bool:
        return any(stage.skin.touched for stage in self.pipeline.stages)

    def _work(
        self,
        scans: list[Scan],
        start_ns: int,
        wall_s: float,
        now_s: float,
        further: Sequence[list[Scan]] = (),
    ) -> None:
        """Work on each scan to its end, and publish its outcome. `start_ns`: when the pass began,
        on `perf_counter_ns`; `further`: scans of further links."""
        source_us = (time.perf_counter_ns() - start_ns) / 1000.0
        cpu = time.thread_time_ns()
        # scans are stamped while polled, so the time must be read after that
        now = time.time() if any((scans, *further)) else wall_s
        for outcome in self.pipeline.advance(scans, now, *further):
            self.pipeline.freshness.came(now_s, outcome.link)
            start_ns = self._publish(outcome, source_us, start_ns, now_s)
            source_us = 0.0  # the time counts for the first scan alone
            before, cpu = cpu, time.thread_time_ns()
            if outcome.is_used and outcome.estimate.injected:
                self._judge_touch(cpu - before)

    def _judge_touch(self, took_ns: int) -> None:
        """Let the ladder know the CPU time of a touch."""
        ladder, limit_ns = (
            self.pipeline.ladder,
            self._touch_ns(sum(stage.skin.hubs for stage in self.pipeline.stages)),
        )
        if ladder.took(took_ns, limit_ns):
            log.warning(
                "touches take %.0f ms, and have %.0f: samples from now on by %s, %.0f %% of them",
                took_ns / 1e6,
                limit_ns / 1e6,
                ladder.name,
                100.0 * ladder.rung.share,
            )

    def _touch_ns(self, hubs: int) -> float:
        """Time that a touch may take of the time between two scans [ns]."""
        return 1e6 * TOUCH_SHARE * self.config.source.period_ms / max(hubs, 1)

    def _think(self, now_s: float) -> None:
        """Take a second opinion, and publish the estimate again where that has improved it."""
        outcome = self.pipeline.think()
        if outcome is not None:
            took_us = _stages_us(outcome)
            self._send_estimate(self._estimate(now_s), took_us, now_s)

    def _look_at_door(self, now_s: float, *, asked: bool) -> None:
        """Take poses, subscriptions and changes; while no scan needs poses, only now and then."""
        if asked or now_s >= self._next_look_s:
            self._next_look_s = now_s + LOOK_S
            self.door.look(self.link, now_s)

    def _reset(self) -> str:
        """Forget all touches; → why that was not done."""
        try:
            self.pipeline.reset()
        except SetupError as error:
            return str(error)
        if self.belief is not None:
            self.belief.remove()
        return ""

    def _on_pose(self, t: float, x: float, y: float, theta: float, link: int = 0) -> None:
        now, poses = time.time(), self.pipeline.stages[link].poses
        far = poses.far
        poses.add(t, x, y, theta, now)
        self._watches[link].add(t, now, is_far=poses.far > far)

    def _on_prior(self, pose: ToldPose, t: float) -> str:
        late_s = abs(time.time() - t)
        if late_s > PRIOR_S:
            return f"its time is {late_s:.0f} s off this clock"
        numbers = [k for k, name in enumerate(self._names) if name == pose.object]
        if pose.object and not numbers:
            return f"no object {pose.object}; there are {', '.join(self._names)}"
        return self.pipeline.tell(pose, numbers or None)

    def close(self) -> None:
        """Stop the skin and free everything that is open."""
        self._opened.close()

    def _publish(self, outcome: Outcome, source_us: float, start_ns: int, now_s: float) -> int:
        """Publish the outcome of a scan, on which work began at `start_ns`; → the time now, on
        `perf_counter_ns` as well."""
        begin_ns = time.perf_counter_ns()
        # time of the publication before this one, which is not over yet
        publish_us = self._publish_us
        total_us = (begin_ns - start_ns) / 1000.0 + publish_us
        lat_us = _stages_us(outcome) | {
            "source": source_us,
            "publish": publish_us,
            "total": total_us,
        }
        is_used = outcome.is_used and self.pipeline.has_object
        if is_used or self._is_news(outcome.estimate):
            self._send_estimate(self._estimate(now_s), lat_us, now_s)
        is_read = self.pipeline.freshness.links[outcome.link].last is not Why.SCANS_MISTIMED
        if self.config.publish.counts and is_read and self.link.wants(messages.COUNTS):
            t, raw = outcome.estimate.t, self.pipeline.stages[outcome.link].skin.counts
            told = messages.counts(t, raw, self._seq, outcome.link)
            self.link.send(messages.COUNTS, told, t)
        if outcome.activation is not None:
            self._send_activation(outcome.activation, outcome.sensor, now_s, outcome.link)
        self.latencies.add(lat_us)
        end_ns = time.perf_counter_ns()
        self._publish_us = (end_ns - begin_ns) / 1000.0
        return end_ns

    def _is_news(self, estimate: Estimate) -> bool:
        told = self._told
        if told is None or told.status is not estimate.status:
            return True
        return told.t != estimate.t and self.pipeline.has_object

    def _send_estimate(self, estimate: Estimate, lat_us: dict[str, float], now_s: float) -> None:
        self._seq += 1
        wall_s = time.time()
        self._told, self._next_estimate_s = estimate, now_s + self._estimate_s
        before, self._why = self._why, self.pipeline.freshness.why(estimate, now_s)
        if self._why is not before:
            self.link.tell(self._state())
        self._notices.estimate(estimate, self._why, self._reason(), now_s)
        self._estimate_sent = messages.estimate(
            estimate,
            names=self._names,
            seq=self._seq,
            why=self._why,
            mono_ns=time.monotonic_ns(),
            age_us=(wall_s - estimate.t) * 1e6 if estimate.t else 0.0,
            overruns=self.counters.overruns,
            degraded=int(self.pipeline.ladder.rung.step),
            lat_us=lat_us,
            links=self.pipeline.freshness.of_links(now_s),
        )
        self.link.send(messages.ESTIMATE, self._estimate_sent, estimate.t)

    def _send_activation(
        self, activation: Activation, sensor: Poses | None, now_s: float, number: int
    ) -> None:
        t, link = activation.t, self.link
        if link.wants(messages.TAXELS):
            link.send(messages.TAXELS, messages.taxels(activation, sensor, self._seq, number), t)
        patches, skin = self.patches[number], self.pipeline.stages[number].skin
        if link.wants(messages.CONTACTS) and (skin.touched or patches.now):
            patches.on_scan(activation.z)
            told = messages.contacts(t, patches, sensor, self._seq, number)
            link.send(messages.CONTACTS, told, t)
        due = self.pipeline.estimate.contact and now_s >= self._next_particles_s
        if due and self.pipeline.has_object and link.wants(messages.PARTICLES):
            self._next_particles_s = now_s + 1.0 / PARTICLES_HZ
            belief = self.pipeline.estimator.rule.belief
            cloud = messages.particles(t, self._seq, belief.pose, belief.weight)
            link.send(messages.PARTICLES, cloud, t)

    def _publish_due(self, now_s: float) -> None:
        """Publish without a scan: an estimate whose status has changed or whose time has come, and
        health."""
        estimate = self._estimate(now_s)
        if self._is_news(estimate) or now_s >= self._next_estimate_s:
            self._send_estimate(estimate, dict.fromkeys(messages.STAGES, 0.0), now_s)
        self._send_advice(now_s)
        if now_s >= self._next_health_s:
            wall_s = time.time()
            self._next_health_s = now_s + HEALTH_S
            array = self.link.report.array
            for source in self.sources:
                source.heed(
                    connected=array.connected, malformed=array.malformed, reason=array.reason
                )
            self._health_sent = health.of(self, self._seq, now_s, wall_s)
            self.link.send(messages.HEALTH, self._health_sent, wall_s)
            for k, stage in enumerate(self.pipeline.stages):
                fault, match = self._watches[k].fault, stage.fresh.is_whole
                name, wiring = self.config.names[k], stage.skin.wiring
                self._notices.inputs(fault, wiring, match=match, now_s=now_s, link=name)
            self._notices.links(self.of_each(now_s), now_s)
            self.link.tell(self._state())

    def _send_advice(self, now_s: float) -> None:
        """Publish new advice, and from time to time again as long as it holds."""
        advice, t = self.pipeline.advice, self.pipeline.estimate.t
        is_due = advice is not self._advised or now_s >= self._next_advice_s
        if advice is not None and is_due and self.link.wants(messages.ADVICE):
            self._advised, self._next_advice_s = advice, now_s + ADVICE_S
            told = messages.advice(advice, t, self._seq, self.config.names)
            self.link.send(messages.ADVICE, told, t)

    def _estimate(self, now_s: float) -> Estimate:
        """The estimate as published at the time `now_s`."""
        return self.pipeline.freshness.judged(self.pipeline.estimate, now_s)

    def _status_line(self, now_s: float) -> str:
        if all(source.waits_for for source in self.sources):
            return f"waiting, {self.source.waits_for}"
        estimate = self._estimate(now_s)
        sure = "not valid" if self._why else f"p {estimate.p:.1%}"
        line = f"{estimate.status.name.lower()}, {sure}"
        return f"{line}, contacts {estimate.contacts}, overruns {self.counters.overruns}"

    def state(self) -> dict[str, Any]:
        """The estimate and health published last, and the rest of the answer to `status`."""
        return {"estimate": self._estimate_sent, "health": self._health_sent, **self._state()}

    def _state(self) -> dict[str, Any]:
        """The part of the answer to `status` that no message has."""
        sensor_pose = {
            "endpoint": self.config.sensor_pose.endpoint,
            "topics": self.link.report.robot.topics,
            "fault": "; ".join(filter(None, (watch.fault for watch in self._watches))),
        }
        waits_for, why = self._waits_for, self._reason()
        return {"waits_for": waits_for, "why": why, "sensor_pose": sensor_pose}

    def _reason(self) -> str:
        """Why the estimate published last is not valid, and the cure; empty where it is."""
        facts = {Why.NO_SCAN: self._waits_for, Why.NO_POSE: self._watches[0].fault}
        estimate, fact = self._told or self.pipeline.estimate, facts.get(self._why, "")
        return self.pipeline.freshness.sentence(self._why, estimate, fact)

    @property
    def _named(self) -> dict[str, Layout]:
        """The layouts by the links' names; none where there is one skin."""
        several = len(self.layouts) > 1
        return dict(zip(self.config.names, self.layouts, strict=True)) if several else {}

    @property
    def _waits_for(self) -> str:
        """What each source waits for, with its links where there are several."""
        if len(self.buses) == 1:
            return self.source.waits_for
        return "; ".join(
            f"{', '.join(self.config.names[k] for k in bus.links)}: {bus.source.waits_for}"
            for bus in self.buses
            if bus.source.waits_for
        )

    def of_each(self, now_s: float) -> dict[str, Why]:
        """For each link by its name, why its scans are of no use now, VALID where they are."""
        whys = self.pipeline.freshness.of_links(now_s)
        return dict(zip(self.config.names, whys, strict=True))

    def _recorder_of(self, link: int) -> Recorder | None:
        """The recorder of the bus that a link is the first on."""
        return self.recorder if not link or self.recorder is None else self.recorder.beside[link]

    @staticmethod
    def _recorded_beside(recorder: Recorder | None) -> list[OnPose | None]:
        return [] if recorder is None else [one.pose for one in recorder.beside.values()]

    def pose_figures(self, t: float, link: int = 0) -> PoseFigures:
        """Figures of the robot's poses at the Unix time t; to be called once a second."""
        if not self.config.sensor_pose.endpoint or self._replays_poses:
            return PoseFigures()
        line = self.link.report.robot
        state = {"connected": line.connected, "refused": line.refused}
        return self._watches[link].look(t, line.malformed, line.reason, line.topics, **state)


def _stages_us(outcome: Outcome) -> dict[str, float]:
    """The time of each stage of the work on an outcome, the others 0."""
    return dict.fromkeys(messages.STAGES, 0.0) | {
        "skin": outcome.skin_ns / 1000.0,
        "propose": outcome.propose_ns / 1000.0,
        "filter": outcome.filter_ns / 1000.0,
    }


def _digest(config: Config) -> str:
    """Of all keys, whoever sets them; of links and of advice only where they are used."""
    used = {"links": config.links, "advice": config.advice.enabled, "is_sized": False}
    given = {name: value for name, value in asdict(config).items() if used.get(name, True)}
    return hashlib.sha256(repr(given).encode()).hexdigest()[:16]


def _watch_of(config: Config) -> PoseWatch:
    return PoseWatch(config.sensor_pose.endpoint, config.source.period_ms / 1000.0)
