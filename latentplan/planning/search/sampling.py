"""Random numbers for a search; the numbers of an environment do not depend on the other environments of the call."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from latentplan.config.checks import shown
from latentplan.planning.search.products import contract

# Chosen on the problems of `scripts/bench/problems.py`: smooth sequences find other ways, white ones improve each step.
SMOOTH_SCALE, WHITE_SCALE = 1.25, 0.5

MODEL_STREAM = 0x5DEECE66D  # makes the seed of a model's stream another than the seeds it is made of

Generators = torch.Generator | Sequence[torch.Generator] | None


class Streams:
    """The random streams of one plan.

    Every plan takes two numbers from a generator, whatever its number of iterations, and draws from streams that are
    seeded with these numbers. An environment's random numbers therefore do not depend on the other environments.

    Args:
        generator: One generator that all environments share, or a list with one each; None takes torch's default.
        batch: Number of environments.
        device: Device of the noise.

    Raises:
        TypeError: The generator is neither a generator nor a list of generators.
        ValueError: The list of generators does not have one for each environment.
    """

    def __init__(self, generator: Generators, batch: int, device: torch.device) -> None:
        is_shared = generator is None or isinstance(generator, torch.Generator)
        sources = _as_list(generator)
        if not is_shared and len(sources) != batch:
            raise ValueError(f"a list of generators needs one for each of {batch} environments, got {len(sources)}")
        seeds = [_draw_seeds(source) for source in sources]
        self._noise = [torch.Generator(device).manual_seed(first) for first, _ in seeds]
        self._policy_seeds = [second for _, second in seeds] * (batch if is_shared else 1)
        self._device = device

    def noise(
        self, num: int, horizon: int, action_dim: int, noise_beta: float, white_share: float, dtype: torch.dtype
    ) -> tuple[Tensor, Tensor | None]:
        """Returns Gaussian noise of unit variance, (1 or batch, num, horizon, action), and the scale of each sequence.

        Args:
            num: Number of sequences.
            horizon: Steps of a sequence.
            action_dim: Numbers in an action.
            noise_beta: Exponent of coloured noise, which correlates the steps; 0 is white.
            white_share: Share of the sequences that are white in spite of `noise_beta`. Above 0 the coloured sequences
                explore further, by `SMOOTH_SCALE`, and the white ones stay closer to the mean, by `WHITE_SCALE`.
            dtype: Precision of the noise.

        Returns:
            The noise, coloured sequences first, and the factors of its standard deviation, (num, 1, 1); None if all of
            it has one colour.
        """
        size = (num, horizon, action_dim)
        drawn = [torch.randn(size, generator=source, device=self._device, dtype=dtype) for source in self._noise]
        white = drawn[0][None] if len(drawn) == 1 else torch.stack(drawn)
        num_white = round(white_share * num)
        if noise_beta == 0.0 or horizon == 1 or num_white == num:
            return white, None
        factor = torch.tensor(_colour_factor(horizon, noise_beta), device=self._device, dtype=dtype)
        smooth = contract("th,bnha->bnta", factor, white[:, : num - num_white])
        if num_white == 0:
            return smooth, None
        scale = torch.full((num, 1, 1), SMOOTH_SCALE, device=self._device, dtype=dtype)
        scale[num - num_white :] = WHITE_SCALE
        return torch.cat([smooth, white[:, num - num_white :]], dim=1), scale

    def policy_generators(self) -> list[torch.Generator]:
        """Returns a stream for each environment's policy samples."""
        return [torch.Generator(self._device).manual_seed(seed) for seed in self._policy_seeds]

    def model_generator(self) -> torch.Generator:
        """Returns the stream of a model that samples, which all environments of the call share."""
        seed = sum(self._policy_seeds) % 2**62 ^ MODEL_STREAM
        return torch.Generator(self._device).manual_seed(seed)


def _as_list(generators: Generators) -> list[torch.Generator | None]:
    if generators is None or isinstance(generators, torch.Generator):
        return [generators]
    if not isinstance(generators, Sequence) or not all(isinstance(each, torch.Generator) for each in generators):
        raise TypeError(
            f"generator must be a torch.Generator or a list with one for each environment, got {shown(generators)}"
        )
    return list(generators)


def _draw_seeds(generator: torch.Generator | None) -> tuple[int, int]:
    device = "cpu" if generator is None else generator.device
    first, second = torch.randint(0, 2**62, (2,), generator=generator, device=device).tolist()
    return first, second


@lru_cache(maxsize=32)
def _colour_factor(horizon: int, noise_beta: float) -> list[list[float]]:
    """Returns the Cholesky factor of the covariance over steps of noise with power 1 / frequency**noise_beta.

    The noise has unit variance. The spectrum covers twice the horizon: over the horizon alone the noise would be
    periodic, and the last step correlated with the first. It covers eight steps at least: noise without a constant part
    changes its sign within the window, so that over a window of four steps it would be rougher than white noise.
    Coloured noise for CEM is from Pinneri et al. 2020, "Sample-efficient cross-entropy method for real-time planning",
    section 3.1.
    """
    window = max(2 * horizon, 8)
    frequency = torch.arange(1, window // 2 + 1, dtype=torch.float64, device="cpu") / window
    power = frequency**-noise_beta
    lag = torch.arange(horizon, dtype=torch.float64, device="cpu")
    covariance = (power * torch.cos(2 * torch.pi * frequency * lag[:, None])).sum(dim=1) / power.sum()
    toeplitz = covariance[(lag[:, None] - lag[None, :]).abs().long()]
    factor: list[list[float]] = torch.linalg.cholesky(toeplitz + 1e-9 * torch.eye(horizon, device="cpu")).tolist()
    return factor
