"""Flags that several benchmarks share."""

from __future__ import annotations

from dataclasses import dataclass

from latentplan.commands.shell import ComputeRequest
from latentplan.config import Config, UserError
from latentplan.config.checks import at_least
from latentplan.config.files import Layer, Preset, compose


def compute_on_processor(request: ComputeRequest) -> None:
    """Sets the device of a benchmark that measures the processor alone.

    Raises:
        UserError: The command line asks for a GPU.
    """
    if request.device == "cuda":
        raise UserError("this benchmark measures the processor alone: leave out --device cuda")
    object.__setattr__(request, "device", "cpu")


@dataclass(frozen=True, kw_only=True)
class ComposeRequest(ComputeRequest):
    """Flags for the settings of a run, in a benchmark that starts no run.

    Attributes:
        domain: Domain of `dm_control.suite`, for its settings; None takes `walker`.
        preset: Machine class, as for training; None takes `gpu` where CUDA is usable, else `cpu`.
        action_dim: Size of the action; None asks the simulator.
    """

    domain: str | None = None
    preset: Preset | None = None
    action_dim: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_dim is not None:
            at_least(self, action_dim=1)

    def compose(self, settings: Layer) -> Config:
        """The settings that a run with this domain, preset and device would have.

        Args:
            settings: Given settings, by section and name.

        Raises:
            UserError: The domain is unknown or a value is not allowed.
        """
        layer = {**settings, "env": {"domain": self.domain or "walker"}, "run": {"device": self.device}}
        return compose({}, layer, self.preset or "auto")

    def action_size(self, config: Config) -> int:
        """The size of the action: the given one, else that of the environment.

        Raises:
            UserError: The environment cannot be made.
        """
        if self.action_dim is not None:
            return self.action_dim
        from latentplan.envs import make_env

        env = make_env(config.env)
        try:
            return int((env.action_space.shape or (1,))[0])
        finally:
            env.close()


@dataclass(frozen=True, kw_only=True)
class SearchRequest(ComputeRequest):
    """Flags for the size of a search.

    Attributes:
        samples: Candidates per iteration.
        horizon: Model steps of each candidate.
        iterations: Refits of each search.
    """

    samples: int = 500
    horizon: int = 20
    iterations: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, samples=2, horizon=1, iterations=1)

    @property
    def sizes(self) -> dict[str, int]:
        """Samples, horizon and iterations, by name."""
        return {"samples": self.samples, "horizon": self.horizon, "iterations": self.iterations}
