"""A whole daemon on a fake clock, with faults that are drawn from a seed.

Real are the daemon and the recorder, with workers that work one after the other when the
simulation lets them. The skin with its robot, the machine and its door are the harness's; the disk
and the faults are simulated. The same seed leads to the same run.
"""

import json
import traceback
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from taxeld.commands import replay
from taxeld.config import file as config_file
from taxeld.estimator.estimate import Estimate, Status
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome
from taxeld.service.loop import Daemon
from taxeld.service.notify import Notifier
from taxeld.source.recorder import Recorder
from taxeld.stream import messages, topics
from taxeld_hil.grade.reconcile import laws
from tests.rig.sessions import poses_of
from tests.rig.simulated_world import DISK, DOOR, NO_DOOR, Drawn, DrawnDoor, World, draw

REST_S = 0.2  # at the end, for what is on its way
NOT_IN_A_RECORDING = {"reset", "tare"}


class Run:
    """One life of a daemon."""

    def __init__(
        self, seed: int, place: Path, faults: list[Drawn], moves: bool, end_s: float = 0.0
    ) -> None:
        """The session is recorded into `place`; `end_s`: of the run, by scenario time."""
        self.broken: list[str] = []
        self.estimates: list[Estimate] = []  # one for each scan, as it was told last
        self.unsent = 0
        self.compared: list[str] = []  # the estimates were compared with those of these
        self.world = World(seed, faults, moves)
        self.world.end_s = end_s or self.world.end_s
        self._sent: list[dict[str, Any]] = []  # estimates
        self._outcomes: list[Outcome] = []
        self._poses = 0  # that were taken
        self._kinds = {fault.kind for fault in faults}
        self._place = place
        self._config = config_file.parse(
            '[source]\nkind = "can"\ninterface = "slcan"\nchannel = "memory"\n'
            f'[scene]\nbundle = "box"\n[filter]\nproposal = "manifold"\nseed = {seed}\n'
            '[publish]\nendpoints = ["ipc:///nowhere/s"]\n[control]\nendpoint = ""\n'
            + '[sensor_pose]\nendpoint = "ipc:///nowhere/p"\n'
            * moves
        )
        try:
            self._live()
            self._judge_recording()
        except Exception as error:
            self.broken.append("".join(traceback.format_exception(error)[-3:]))

    def _live(self) -> None:
        world = self.world
        given = {"worker": world.worker, "open_new": world.open_new}
        with Recorder(self._place, moves=world.moves, **given) as self._recorder:
            daemon = Daemon(self._config, self._recorder, world)
            try:
                self._listen_to(daemon)
                daemon._loop(Notifier({}), self._ends)
                self._judge_end(daemon)
                daemon.link.detach()
                world.advance(world.now + 0.2)  # the door reads what is left, and ends
            finally:
                daemon.close()
        got = [packet for door in world.doors if isinstance(door, DrawnDoor) for packet in door.got]
        self._law(got == world.taken, "doors got other packets than the pair took")

    def _ends(self) -> bool:
        self.world.is_sending = self.world.now < self.world.end_s
        return self.world.now >= self.world.end_s + REST_S

    def _listen_to(self, daemon: Daemon) -> None:
        link, pipeline = daemon.link, daemon.pipeline
        send, advance, think = link.send, pipeline.advance, pipeline.think
        add, self._poses = pipeline.poses.add, pipeline.poses.taken  # since the start

        def posed(*given: float) -> None:
            self._poses += 1
            add(*given)

        def sent(topic: bytes, message: Mapping[str, Any], t: float) -> None:
            if topic == topics.ESTIMATE:
                self._sent.append(dict(message))
            send(topic, message, t)

        def advanced(scans: Any, now: float) -> Iterator[Outcome]:
            for outcome in advance(scans, now):
                self._outcomes.append(outcome)
                yield outcome

        def thought() -> Outcome | None:
            outcome = think()
            if outcome is not None:
                self._outcomes.append(outcome)
            return outcome

        link.send, pipeline.think = sent, thought  # type: ignore[method-assign]
        pipeline.poses.add = posed  # type: ignore[method-assign]
        pipeline.advance = advanced  # type: ignore[method-assign,assignment]

    def _judge_end(self, daemon: Daemon) -> None:
        """All faults are long over."""
        self.unsent = daemon.link.unsent
        self._law(daemon.link.is_ready, "no door at the end")
        self._law(self._sent[-1]["status"] != Status.STALE, "stale at the end")
        used = [o for o in self._outcomes if o.is_used]
        told = iter(self._sent)
        in_order = all(any(e["t"] == o.estimate.t for e in told) for o in used)
        self._law(in_order, "a scan that was used has no estimate, or not in the order of scans")
        numbers = [e["seq"] for e in self._sent]
        self._law(numbers == list(range(1, len(numbers) + 1)), "estimates are not numbered in turn")
        counted = daemon.health(self.world.now, self.world.unix())
        self._law(counted["estimator"]["scans"] == len(used), "a scan has no outcome")
        self.world.rig.ledger.poses_heard = self._poses
        for law in laws(self.world.rig.ledger.entries(), counted, line=False):
            self._law(law.holds, f"{law.name}: {law.expected}, where {law.counted} are counted")
        self.estimates = of_scans(self._outcomes)

    def _judge_recording(self) -> None:
        """It replays to the same estimates, or, where the disk failed, to the first of them."""
        written, whole = self._recorder, not self._kinds & {"disk full", "disk error"}
        lost = written.failed or written.dropped > 0
        self._law(not (whole and lost), "the recording has ended")
        if self._kinds & NOT_IN_A_RECORDING:
            return
        self.compared.append("recording cut" if written.failed else "recording")
        pipeline = replay.open_pipeline(self._place, self._config)
        replayed = of_scans(replay.outcomes(self._place, pipeline))
        live = self.estimates
        if not written.failed:
            self._law(len(replayed) - len(live) in (0, 1), "scans are not in the recording")
        elif self.world.moves:  # of the last, the poses may not have been written
            until = poses_of(self._place)[-1:]
            replayed = [e for e in replayed if until and e.t <= until[0][0]]
        alike = (
            list(map(as_bytes, replayed[: len(live)])) == list(map(as_bytes, live))[: len(replayed)]
        )
        self._law(alike, "the recording replays to other estimates")

    def _law(self, holds: bool, otherwise: str) -> None:
        if not holds:
            self.broken.append(otherwise)


def of_scans(outcomes: Iterable[Outcome]) -> list[Estimate]:
    """The last estimate of each scan."""
    found: dict[float, Estimate] = {}
    for outcome in outcomes:
        found[outcome.estimate.t] = outcome.estimate
    return list(found.values())


def as_bytes(estimate: Estimate) -> str:
    return json.dumps(messages.estimate(estimate, names=["box"], seq=0, why=Why.VALID))


def simulate(seed: int, place: Path) -> tuple[Run, list[str]]:
    """A run, and the laws that it broke; where door or disk alone failed, and no pose came later
    by that, its estimates must be those of a run without faults."""
    faults, moves = draw(seed)
    run = Run(seed, place / "faults", faults, moves)
    broken, kinds = run.broken, {fault.kind for fault in faults}
    allowed = {*DISK} if moves else {*DOOR, *NO_DOOR, *DISK}
    if kinds <= allowed:
        run.compared.append("undisturbed")
        calm = Run(seed, place / "calm", [], moves, run.world.end_s)
        broken = broken + [f"without faults: {law}" for law in calm.broken]
        if list(map(as_bytes, calm.estimates)) != list(map(as_bytes, run.estimates)):
            broken.append("estimates are others than without faults")
    return run, broken
