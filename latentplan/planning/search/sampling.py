"""Random numbers for a search: the same for an environment whoever shares the call."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

Generators = torch.Generator | Sequence[torch.Generator] | None


class Streams:
    """The random streams of one plan.

    Every plan takes two numbers from a generator, whatever its iterations, and draws from streams seeded with them.
    So an environment keeps its random numbers when others stop earlier, start cold or join the call.

    Args:
        generator: One generator that all environments share, or one for each; None takes torch's default.
        batch: Number of environments.
        device: Where the noise is needed.

    Raises:
        ValueError: A list of generators does not hold one for each environment.
    """

    def __init__(self, generator: Generators, batch: int, device: torch.device) -> None:
        is_shared = generator is None or isinstance(generator, torch.Generator)
        sources = [generator] if is_shared else list(generator)  # type: ignore[arg-type]
        if not is_shared and len(sources) != batch:
            raise ValueError(f"a list of generators needs one for each of {batch} environments, got {len(sources)}")
        seeds = [_draw_seeds(source) for source in sources]  # type: ignore[arg-type]
        self._noise = [torch.Generator(device).manual_seed(first) for first, _ in seeds]
        self._policy_seeds = [second for _, second in seeds] * (batch if is_shared else 1)
        self._device = device

    def noise(self, num: int, horizon: int, action_dim: int, noise_beta: float, dtype: torch.dtype) -> Tensor:
        """Unit Gaussian noise, (1 or batch, num, horizon, action); `noise_beta` above 0 correlates the steps."""
        size = (num, horizon, action_dim)
        drawn = [torch.randn(size, generator=source, device=self._device, dtype=dtype) for source in self._noise]
        white = drawn[0][None] if len(drawn) == 1 else torch.stack(drawn)
        if noise_beta == 0.0 or horizon == 1:
            return white
        factor = torch.tensor(_colour_factor(horizon, noise_beta), device=self._device, dtype=dtype)
        return torch.einsum("th,bnha->bnta", factor, white)

    def policy_generators(self) -> list[torch.Generator]:
        """A stream for each environment's policy samples."""
        return [torch.Generator(self._device).manual_seed(seed) for seed in self._policy_seeds]


def _draw_seeds(generator: torch.Generator | None) -> tuple[int, int]:
    device = "cpu" if generator is None else generator.device
    first, second = torch.randint(0, 2**62, (2,), generator=generator, device=device).tolist()
    return first, second


@lru_cache(maxsize=32)
def _colour_factor(horizon: int, noise_beta: float) -> list[list[float]]:
    """Lower factor of the covariance over steps of noise with power 1 / frequency**noise_beta, unit variance.

    The spectrum covers twice the horizon, so that the end of a sequence is not tied to its start (as it is when a
    sequence of just the horizon's length is transformed). Pinneri et al. 2020, "Sample-efficient cross-entropy
    method for real-time planning", section 3.1, has the idea.
    """
    frequency = torch.arange(1, horizon + 1, dtype=torch.float64) / (2 * horizon)
    power = frequency**-noise_beta
    lag = torch.arange(horizon, dtype=torch.float64)
    covariance = (power * torch.cos(2 * torch.pi * frequency * lag[:, None])).sum(dim=1) / power.sum()
    toeplitz = covariance[(lag[:, None] - lag[None, :]).abs().long()]
    factor: list[list[float]] = torch.linalg.cholesky(toeplitz + 1e-9 * torch.eye(horizon)).tolist()
    return factor
