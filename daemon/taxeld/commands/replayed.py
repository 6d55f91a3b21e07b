"""A recorded session for programs: what each scan led to, and the belief after it."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from taxeld.arrays import Floats, Poses
from taxeld.commands.replay import open_pipeline, outcomes
from taxeld.config import file as config_file
from taxeld.config.tables import Config
from taxeld.estimator.estimate import Estimate
from taxeld.pipeline.outcome import Outcome
from taxeld.source import session


class Replay:
    """A recorded session, estimated anew; iterating over it goes through its scans, once.

    Same session, configuration and seed: same estimates, bit for bit.
    """

    def __init__(
        self, directory: str | Path, config: Config | None = None, seed: int | None = None
    ) -> None:
        """`config`: in place of the session's own `config.toml`; `seed`: of `filter.seed`.

        Raises:
            SetupError: what the configuration names cannot be used.
            ConfigError: the configuration itself.
        """
        self.directory = Path(directory)
        config = config or config_file.load(self.directory / session.CONFIG)
        if seed is not None:
            config = replace(config, filter=replace(config.filter, seed=seed))
        self.pipeline = open_pipeline(self.directory, config)
        self.config = self.pipeline.config
        self.model = self.pipeline.estimator.model
        self._outcomes = outcomes(self.directory, self.pipeline)

    def __iter__(self) -> Iterator[Outcome]:
        """What each scan led to: estimate, activation, and sensor pose.

        Raises:
            SetupError: the session cannot be read, or is damaged.
        """
        return self._outcomes

    @property
    def belief(self) -> tuple[Poses, Floats]:
        """Particles (N, 3) and their weights (N,) of sum 1, after the scan that was taken last."""
        belief = self.pipeline.estimator.rule.belief
        return belief.pose.copy(), belief.weight.copy()

    def is_valid(self, estimate: Estimate) -> bool:
        """Whether the daemon would say that this estimate, the last, may be used."""
        return self.pipeline.freshness.is_valid(estimate)
