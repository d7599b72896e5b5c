"""The cross-entropy search for a model that is one NumPy function of a state and an action sequence.

`CEMTrajectoryOptimizer` is a `CEMPlanner` with NumPy arrays and other argument names.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from latentplan.planning.plan import Plan
from latentplan.planning.search.cem import CEMPlanner
from latentplan.planning.search.elites import refit

if TYPE_CHECKING:
    import numpy as np

    RolloutFunction = Callable[[np.ndarray, np.ndarray], float]


class CEMTrajectoryOptimizer:
    """Cross-entropy search with a function `rollout_fn(state, sequence) -> return`, one sequence at a time.

    Args:
        horizon: Steps of a sequence.
        action_dim: Numbers in an action.
        num_candidates: Sequences per iteration, the present mean among them.
        num_elites: Best sequences, which refit the distribution.
        num_iterations: Number of refits.
        smoothing: Weight of the new statistics, in (0, 1].
        action_low: Lowest action.
        action_high: Highest action; a search starts with half the action range as its standard deviation.
        seed: Seed of the sampling noise; the optimizer has its own random stream.
    """

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        num_candidates: int = 100,
        num_elites: int = 10,
        num_iterations: int = 5,
        smoothing: float = 0.8,
        action_low: float = -1.0,
        action_high: float = 1.0,
        seed: int = 0,
    ) -> None:
        self.horizon = horizon
        self.action_dim = action_dim
        self.num_candidates = num_candidates
        self.num_elites = num_elites
        self.num_iterations = num_iterations
        self.smoothing = smoothing
        self.action_low = action_low
        self.action_high = action_high
        low, high = (torch.as_tensor(bound, dtype=torch.float64, device="cpu") for bound in (action_low, action_high))
        self._planner = CEMPlanner(
            action_dim=action_dim,
            horizon=horizon,
            num_samples=num_candidates,
            num_elites=num_elites,
            num_iterations=num_iterations,
            warm_start_iterations=num_iterations,
            smoothing=smoothing,
            init_std=(high - low) / 2,
            min_std=0.0,
            final="mean",
            noise_beta=0.0,
            keep_elite_fraction=0.0,
            action_low=action_low,
            action_high=action_high,
        )
        self._generator = torch.Generator().manual_seed(seed)

    def plan(
        self, initial_state: np.ndarray, rollout_fn: RolloutFunction, warm_start_mean: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns mean and variance of the search distribution, float64 (horizon, action) each.

        Args:
            initial_state: Passed to `rollout_fn` unchanged.
            rollout_fn: `rollout_fn(initial_state, sequence (horizon, action)) -> return`, maximised.
            warm_start_mean: Mean at the start of the search, (horizon, action); None takes the middle of the bounds.

        Raises:
            ValueError: The mean at the start has another number of dimensions, or is not finite.
        """
        model = _RolloutModel(initial_state, rollout_fn)
        previous = None if warm_start_mean is None else _make_plan(warm_start_mean)
        no_state = torch.zeros(1, 0, dtype=torch.float64, device="cpu")  # the model holds the state
        plan = self._planner.plan(model, no_state, previous, generator=self._generator)
        if bool(plan.info["is_fallback"].any()):
            warnings.warn(
                "no sequence had a finite return; the plan is the start of the search", RuntimeWarning, stacklevel=2
            )
        return plan.mean[0].numpy(), plan.var[0].numpy()

    def shift(self, mean: np.ndarray) -> np.ndarray:
        """Returns a plan's mean one step later, (horizon, action); its last action is the middle of the bounds.

        Args:
            mean: The mean, (horizon, action).
        """
        low, high = (bound[0, -1:].numpy() for bound in self._planner.bounds)
        shifted: np.ndarray = (low + high).repeat(len(mean), axis=0) / 2
        shifted[:-1] = mean[1:]
        return shifted

    def step_numerical_example(
        self,
        candidates: np.ndarray,
        returns: np.ndarray,
        prior_mean: np.ndarray,
        prior_var: np.ndarray,
        num_elites: int = 2,
        smoothing: float = 0.8,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns mean and variance (horizon, action) after one refit, and the first action of the mean (action,)."""
        arrays = (torch.as_tensor(array, device="cpu") for array in (candidates, returns, prior_mean, prior_var))
        mean, var = refit(*arrays, num_elites=num_elites, smoothing=smoothing)
        return mean.numpy(), var.numpy(), mean[0].numpy()


class RolloutController:
    """Receding-horizon control with a `CEMTrajectoryOptimizer`; made by `ModelPredictiveController(optimizer, ...)`.

    Args:
        optimizer: The optimizer that searches at every step.
        rollout_fn: `rollout_fn(state, sequence) -> return`.
    """

    def __init__(self, optimizer: CEMTrajectoryOptimizer, rollout_fn: RolloutFunction) -> None:
        self.optimizer = optimizer
        self.rollout_fn = rollout_fn
        self.warm_start: np.ndarray | None = None

    def act(self, current_state: np.ndarray) -> np.ndarray:
        """Returns the first action (action,) of a new plan; the rest starts the next search, see `shift`."""
        mean, _ = self.optimizer.plan(current_state, self.rollout_fn, self.warm_start)
        self.warm_start = self.optimizer.shift(mean)
        return mean[0]

    def reset(self) -> None:
        """Forgets the last plan."""
        self.warm_start = None


class _RolloutModel:
    """A model whose rollout calls a function; the first reward of a sequence is the whole return."""

    def __init__(self, state: np.ndarray, rollout_fn: RolloutFunction) -> None:
        self._state, self._rollout_fn = state, rollout_fn

    def step(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError("a rollout function returns no single steps")

    def rollout(self, state: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        rewards = actions.new_zeros(actions.shape[:2])
        for row, sequence in enumerate(actions.numpy()):
            rewards[row, 0] = float(self._rollout_fn(self._state, sequence.copy()))
        return rewards, state


def _make_plan(mean: np.ndarray) -> Plan:
    """Returns a plan with this mean (horizon, action), of which no action has been executed."""
    sequence = torch.as_tensor(mean, dtype=torch.float64, device="cpu")[None]
    if sequence.ndim != 3 or not bool(torch.isfinite(sequence).all()):
        raise ValueError(
            f"warm_start_mean must be finite numbers (horizon, action), got shape {tuple(sequence.shape[1:])}"
        )
    zero = torch.zeros(1, dtype=torch.long, device="cpu")
    return Plan(sequence, sequence, torch.ones_like(sequence), zero.float(), {}, None, zero == 0, zero)
