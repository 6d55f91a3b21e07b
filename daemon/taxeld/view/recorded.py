"""A session as the messages that a daemon would send: the same maps, by a replay."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from taxeld.arrays import Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config import file as config_file
from taxeld.errors import SetupError
from taxeld.source import session
from taxeld.stream import messages
from taxeld.view.stage import Message, of_scene

PARTICLES_S = 0.05  # between two clouds, as the daemon sends them


class Recording:
    """A session, to be replayed once."""

    def __init__(self, directory: Path, config: Path | None = None) -> None:
        """`config`: in place of the session's own.

        Raises:
            SetupError: there is no session, or what its configuration names cannot be used.
        """
        path = config or directory / session.CONFIG
        if not directory.is_dir() or not path.is_file():
            raise SetupError(
                f"{directory}: is no session (it has no {session.CONFIG}); 'taxeld record' and "
                "'taxeld run --record' make one"
            )
        self.directory = directory
        loaded = config_file.load(path)
        self._pipeline = open_pipeline(directory, loaded)
        self.stage = of_scene(
            self._pipeline.skin.layout,
            self._pipeline.estimator.model.scene,
            Path(loaded.scene.bundle).name,
            truth_of(directory / session.TRUTH),
        )

    def __iter__(self) -> Iterator[Message]:
        """Of each scan: taxels, estimate, particles, as far as it has them.

        Raises:
            SetupError: the session is damaged.
        """
        pipeline, next_s = self._pipeline, -np.inf
        for seq, outcome in enumerate(outcomes(self.directory, pipeline)):
            estimate, activation = outcome.estimate, outcome.activation
            if activation is not None:
                yield messages.TAXELS, messages.taxels(activation, outcome.sensor, seq)
            if not estimate.t:  # nothing was measured yet
                continue
            valid = pipeline.freshness.is_valid(estimate)
            yield messages.ESTIMATE, messages.estimate(estimate, seq=seq, valid=valid)
            if estimate.contact and not estimate.t < next_s < estimate.t + 1.0:
                next_s = estimate.t + PARTICLES_S
                belief = pipeline.estimator.rule.belief
                cloud = messages.particles(estimate.t, seq, belief.pose, belief.weight)
                yield messages.PARTICLES, cloud


def truth_of(path: Path) -> Poses | None:
    """(3,) where the object stood last; None where nobody wrote it down. Raises SetupError."""
    if not path.exists():
        return None
    rows = session.read_poses(path)
    return np.array(rows[-1][1:]) if rows else None
