"""A recorded session for programs: the outcome of each scan, and the belief after it."""

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

    The same session, configuration and seed give the same estimates, bit for bit.
    """

    def __init__(
        self, directory: str | Path, config: Config | None = None, seed: int | None = None
    ) -> None:
        """`config` replaces the session's own `config.toml`; `seed` replaces `filter.seed`.

        Raises:
            SetupError: a file named by the configuration cannot be used.
            ConfigError: the configuration has faults.
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
        """The outcome of each scan: estimate, activation, and sensor pose.

        Raises:
            SetupError: the session cannot be read, or is damaged.
        """
        return self._outcomes

    @property
    def belief(self) -> tuple[Poses, Floats]:
        """Particles (N, 3) and their weights (N,), of sum 1, after the last scan."""
        belief = self.pipeline.estimator.rule.belief
        return belief.pose.copy(), belief.weight.copy()

    def is_valid(self, estimate: Estimate) -> bool:
        """Whether the daemon would mark this estimate, the last one, as valid."""
        return self.pipeline.freshness.is_valid(estimate)
