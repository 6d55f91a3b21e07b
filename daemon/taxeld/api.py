"""The public interface of `taxeld` for programs that import it (docs/api.md).

    from taxeld.api import Replay

    for outcome in Replay("session"):
        print(outcome.estimate.status.name, outcome.estimate.map)

Other names may change at any time. `import taxeld` alone imports none of these names, so that the
commands start at once.
"""

from taxeld.advice.advice import Advised, TouchMemory, advise
from taxeld.advice.candidates import Candidate
from taxeld.commands.advise import remembered
from taxeld.commands.replay import Replay
from taxeld.config.file import load as load_config
from taxeld.config.gate import ConfigError
from taxeld.config.tables import Config, FilterConfig, SkinConfig
from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate, Hypotheses, ProposalKind, Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.layout.read import load as load_layout
from taxeld.model.contacts import Proposal
from taxeld.model.observation import Activation, ObservationModel
from taxeld.model.scene import Scene
from taxeld.model.symmetry import Mode, PoseMetric
from taxeld.pipeline.freshness import Why
from taxeld.pipeline.pipeline import Outcome
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.bundle import load as load_bundle
from taxeld.skin.skin import Skin
from taxeld_protocol.decoder import Scan

__all__ = [
    "Activation",
    "Advised",
    "Bundle",
    "Candidate",
    "Config",
    "ConfigError",
    "Estimate",
    "Estimator",
    "FilterConfig",
    "Hypotheses",
    "Layout",
    "Mode",
    "ObservationModel",
    "Outcome",
    "PoseMetric",
    "Proposal",
    "ProposalKind",
    "Replay",
    "Scan",
    "Scene",
    "SetupError",
    "Skin",
    "SkinConfig",
    "Status",
    "TouchMemory",
    "Why",
    "advise",
    "load_bundle",
    "load_config",
    "load_layout",
    "remembered",
]
