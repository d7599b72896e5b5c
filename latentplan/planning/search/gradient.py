"""Gradient ascent on a plan, for models that are differentiable in the action."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import State
from latentplan.planning.search.scorer import Scorer
from latentplan.planning.search.space import Space

FIRST_STEP = 0.1  # largest change of an action in the first step, in half ranges of the action
MOST_FAILURES = 8  # steps undone in a row after which an environment is done
LEAST_GAIN = 0.1  # gain of a refinement that helps, in standard deviations of the elites' returns
LONGEST_PAUSE = 15


class Refined(NamedTuple):
    """Sequences after gradient ascent.

    Attributes:
        actions: (batch, horizon, action), with a return no lower and a violation no higher than before.
        returns: Their returns, (batch,).
        violations: Their violations, (batch,); None without constraints.
        gain: Return gained, (batch,).
    """

    actions: Tensor
    returns: Tensor
    violations: Tensor | None
    gain: Tensor


class Pause(NamedTuple):
    """How long refinement rests after it did not help; a plan hands it on to the next search.

    Attributes:
        length: Searches that the last pause takes, doubled while refinement does not help, (batch,) int.
        left: Searches of it that are left, (batch,) int.
    """

    length: Tensor
    left: Tensor

    def waited(self) -> Pause:
        """Returns the pause after a search without refinement."""
        return Pause(self.length, (self.left - 1).clamp_min(0))

    def renewed(self, gain: Tensor, spread: Tensor) -> Pause:
        """Returns the pause after a refinement: none where it helped, else a longer one.

        Args:
            gain: Return gained, (batch,).
            spread: Standard deviation of the elites' returns, (batch,).
        """
        helped = gain > LEAST_GAIN * spread
        length = torch.where(helped, 0, (2 * self.length + 1).clamp_max(LONGEST_PAUSE))
        return Pause(length, length)


def ascend(
    scorer: Scorer,
    state: State,
    actions: Tensor,
    *,
    num_steps: int,
    step_size: float | None,
    space: Space,
) -> Refined:
    """Returns sequences improved by gradient ascent on their return.

    A step that does not raise the return, or raises the violation, is undone, and the step size is halved. The ascent
    ends early where steps keep failing.

    Args:
        scorer: Scores sequences.
        state: Start of the plans, rows (batch,).
        actions: Sequences, (batch, horizon, action).
        num_steps: Number of gradient steps.
        step_size: Largest change of an action in the first step, in action units; None takes a twentieth of the range.
        space: Keeps bounds and limits of the actions.

    Raises:
        ValueError: The return is not differentiable in the actions.
    """
    low, high = space.bounds.low, space.bounds.high
    scale = (high - low) / 2 if step_size is None else torch.ones_like(low)
    if space.choices is not None:
        scale = scale.index_fill(2, space.choices.dims, 0.0)
    with torch.enable_grad():
        # A tensor made in inference mode cannot take part in a gradient; its clone can.
        rows = scorer.start_rows(tree_map(lambda leaf: leaf.clone(), state), 1)
        current = actions.clone()
        size = torch.full_like(current[:, :1, :1], FIRST_STEP if step_size is None else step_size)
        before, violation, slope = _measure(scorer, rows, current, scale)
        value, failures = before, torch.zeros_like(before)
        for step in range(num_steps):
            trial = space.decode(space.encode(space.bounds.fit(current + size * slope)))
            trial_value, trial_violation, trial_slope = _measure(scorer, rows, trial, scale)
            accept = (trial_value > value) & (trial_violation <= violation)
            accept = accept | (torch.isfinite(trial_value) & ~torch.isfinite(value))
            accept = accept & (failures < MOST_FAILURES)  # whether others go on changes nothing
            value = torch.where(accept, trial_value, value)
            violation = torch.where(accept, trial_violation, violation)
            chosen = accept[:, None, None]
            current = torch.where(chosen, trial, current)
            slope = torch.where(chosen, trial_slope, slope)
            size = torch.where(chosen, size, size / 2)
            failures = torch.where(accept, 0, failures + 1)
            if step + 1 >= MOST_FAILURES and bool((failures >= MOST_FAILURES).all()):
                break
    return Refined(current, value, violation if scorer.constraints else None, (value - before).nan_to_num(0.0))


def _measure(scorer: Scorer, rows: State, actions: Tensor, scale: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns return (batch,), violation (batch,) and the change of a step of size 1, (batch, horizon, action)."""
    leaf = actions.detach().requires_grad_()
    scores = scorer.score(rows, leaf[:, None])
    returns = scores.returns[:, 0]
    gradient = torch.autograd.grad(returns.sum(), leaf, allow_unused=True)[0] if returns.requires_grad else None
    if gradient is None:  # weights that require gradients may be all that the return depends on
        raise ValueError("gradient_steps above 0 needs a model that is differentiable in the action")
    gradient = torch.nan_to_num(gradient, posinf=0.0, neginf=0.0) * scale  # a row that is not finite is not moved
    slope = gradient / gradient.abs().amax(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(gradient.dtype).tiny)
    violation = torch.zeros_like(returns) if scores.violations is None else scores.violations[:, 0]
    return returns.detach(), violation.detach(), slope * scale
