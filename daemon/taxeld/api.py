"""The public face of `taxeld`: what a program that imports it may rely on.

    from taxeld import api

    layout = api.load_layout("cylinder:rows=5,columns=16,radius_m=0.04,pitch_m=0.015")
    box = api.load_bundle("box", layout, depth_max_m=0.005)

Names that are not listed here may change at any time.
"""

from taxeld.errors import SetupError
from taxeld.estimator.estimate import Estimate, Status
from taxeld.estimator.estimator import Estimator
from taxeld.layout.layout import Layout
from taxeld.layout.read import load as load_layout
from taxeld.model.activation import Activation
from taxeld.model.observation import ObservationModel
from taxeld.model.proposal import Proposal
from taxeld.model.scene import Scene
from taxeld.proposals.bundle import Bundle
from taxeld.proposals.bundle import load as load_bundle
from taxeld.skin.skin import Skin

__all__ = [
    "Activation", "Bundle", "Estimate", "Estimator", "Layout", "ObservationModel", "Proposal",
    "Scene", "SetupError", "Skin", "Status", "load_bundle", "load_layout",
]  # fmt: skip
