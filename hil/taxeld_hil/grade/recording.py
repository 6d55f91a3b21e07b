"""The session that `taxeld record` has left: what its replay estimates is what was published."""

from array import array
from pathlib import Path

import numpy as np

from taxeld.commands.replay import Replay
from taxeld.errors import SetupError
from taxeld.model.scene import Scene
from taxeld.pipeline.freshness import Why
from taxeld.stream import messages
from taxeld_hil.grade import session
from taxeld_hil.grade.session import Reception, Run
from taxeld_hil.scenario.scenario import Scenario


def replayed(directory: Path) -> tuple[Run, Reception, Scene]:
    """A recording as a run of the first object that its configuration names, what a subscriber
    would have got, and that object's scene.

    Raises:
        SetupError: it cannot be replayed, or its configuration names no object.
    """
    recorded = Replay(directory)
    config, links = recorded.config, recorded.pipeline.freshness.of_links
    if not recorded.names:
        raise SetupError(f"{directory}: scene.bundle names no object, so there is no pose to grade")
    rows, began_s, t = array("d"), 0.0, 0.0
    for seq, outcome in enumerate(recorded):
        e, felt = outcome.estimate, outcome.activation
        t = e.t if felt is None else felt.t
        began_s = began_s or t
        why = recorded.why(e)
        message = messages.estimate(e, names=recorded.names, seq=seq, why=why, links=links())
        rows.extend(session.row(t - began_s, message))
    known = config.scene.names
    scenario = Scenario(known[0], known, config.skin.layout)
    run = Run(directory.name, config.filter.seed, "replayed", scenario, t - began_s, [])
    found = session.estimates(rows, len(config.names))
    # a robot may fall silent before the recording ends: what comes then has no pose
    found = found[: 1 + max(np.flatnonzero(found.why != Why.NO_POSE), default=len(found))]
    return run, Reception(found, []), recorded.model.scene
