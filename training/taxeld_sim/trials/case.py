"""A case: what is known, what is touched, by which skin, under which conditions and by whom."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

from taxeld.config.tables import (
    Config,
    FilterConfig,
    LinkConfig,
    SensorPoseConfig,
    SkinConfig,
    SourceConfig,
)
from taxeld.errors import SetupError
from taxeld.layout import read as layouts
from taxeld.model.contacts import Proposal
from taxeld.model.observation import ObservationModel
from taxeld.proposals import bundle
from taxeld.proposals.analytic import ANALYTIC
from taxeld_sim import jobs
from taxeld_sim.world.conditions import Conditions
from taxeld_sim.world.subjects import Subject, model_of

DEFAULT_LAYOUT = SkinConfig().layout
OWN_SEEDS = 2**31  # added to a trial's seed, so that a filter does not draw what its trial drew
GUIDES = "random", "around", "straight", "advised", "push"
MOTIONS = "none", "push"  # of the filter
KINDS = {"paper": "ddpm"}  # of a sampler that a method names otherwise


@dataclass(frozen=True)
class Method:
    """A filter by its parts, as the daemon's configuration has them. What it does not name is the
    configuration that ships: no filter knows what its trial's world draws."""

    proposal: str
    injection: str = FilterConfig().injection
    particles: int = FilterConfig().particles
    particles_max: int = 0  # 0: as many as `particles`
    samples: int = -1  # that a touch brings; negative: half as many as `particles`

    @property
    def injected(self) -> int:
        """Samples that a touch brings."""
        return self.particles // 2 if self.samples < 0 else self.samples


TABLED = Method("table", particles_max=FilterConfig().particles_max)  # nothing is trained for it


@dataclass(frozen=True)
class Case:
    """Trials that differ by their seed alone."""

    known: tuple[Subject, ...]  # what the filter knows
    touched: Subject | None = None  # None: the first known
    layouts: tuple[str, ...] = ()  # a skin for each link, as skin.layout; empty: the default ring
    conditions: Conditions = field(default_factory=Conditions)
    guide: str = "random"  # of GUIDES
    method: Method = TABLED
    motion: str = "none"  # of MOTIONS
    touches: int = 8

    def __post_init__(self) -> None:
        """Raises SetupError where there is no such guide or motion, or no touch."""
        for name, value, known in (
            ("guide", self.guide, GUIDES),
            ("motion", self.motion, MOTIONS),
        ):
            if value not in known:
                raise SetupError(f"{name}: no '{value}'; there are {', '.join(known)}")
        if self.touches < 1:
            raise SetupError("touches: must be at least 1")

    @property
    def subject(self) -> Subject:
        """What is touched."""
        return self.touched or self.known[0]

    @property
    def specs(self) -> tuple[str, ...]:
        """The layouts of all links."""
        return self.layouts or (DEFAULT_LAYOUT,)

    def config(self, seed: int) -> Config:
        """Of a daemon in the trial of a seed."""
        method, given = self.method, self.conditions
        skins = [
            LinkConfig(
                layout=spec,
                full_scale_counts=given.full_scale_counts,
                full_scale_depth_m=self.subject.own_depth_m,
                name=f"link{k}",
            )
            for k, spec in enumerate(self.specs, 1)
        ]
        robot = SensorPoseConfig(endpoint="direct")
        if given.robot_told and given.robot_m:
            robot = replace(robot, sigma_m=given.robot_m)
        return Config(
            source=SourceConfig(kind="can", channel="direct"),
            skin=skins[0],
            links=tuple(skins) if len(skins) > 1 else (),
            sensor_pose=robot,
            filter=FilterConfig(
                particles=method.particles,
                particles_max=method.particles_max or method.particles,
                injected=method.injected,
                injection=method.injection,
                motion=self.motion,
                seed=OWN_SEEDS + seed,
            ),
        )

    @property
    def digest(self) -> str:
        """Hash of all that its trials depend on but the seed."""
        return digest(self, (*self.known, self.subject), self.specs)

    def proposals(self) -> list[Proposal]:
        """Of each known object.

        Raises:
            SetupError: an object has no such sampler.
        """
        name = self.method.proposal
        return [proposal_of(each, name, model_of(each, *self.specs)) for each in self.known]


def digest(what: object, subjects: Iterable[Subject], specs: Iterable[str]) -> str:
    """Hash of a case or a scenario with its `repr`, of the code, and of the files of its objects
    and layouts."""
    found = hashlib.sha256(f"{what!r}\0{code()}".encode())
    for subject in dict.fromkeys(subjects):
        for file in subject.files:
            found.update(file.read_bytes())
    for spec in specs:
        found.update(layouts.read(spec).digest.encode())
    return found.hexdigest()[:16]


def code() -> str:
    """Hash of the code and of the files shipped with it."""
    packages = "taxeld", "taxeld_protocol", "taxeld_sim"
    return jobs.code(tuple(f"{name}/**/*.{end}" for name in packages for end in ("py", "toml")))


@lru_cache(maxsize=32)
def proposal_of(subject: Subject, name: str, model: ObservationModel) -> Proposal:
    """A proposal of an object, whose model this is, by name.

    Raises:
        SetupError: there is no such sampler, or it cannot be used.
    """
    if name in ANALYTIC:
        return ANALYTIC[name](model)
    if subject.sampler:
        from taxeld.proposals.sampler import Sampler  # noqa: PLC0415  (loads onnxruntime)

        path = Path(subject.sampler)
        return Sampler(path.read_bytes(), model.layout, KINDS.get(name, name), path)
    if not subject.is_as_built:
        raise SetupError(f"{subject.name}: has no sampler '{name}'; build a bundle of it")
    return bundle.load(subject.name, model.layout).proposal(name)
