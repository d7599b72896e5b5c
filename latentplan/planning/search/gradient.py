"""Gradient ascent on a plan, for models that are differentiable in the action."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import State
from latentplan.planning.search.scorer import Scorer
from latentplan.planning.search.space import Space


def ascend(
    scorer: Scorer,
    state: State,
    actions: Tensor,
    *,
    num_steps: int,
    step_size: float,
    space: Space,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Returns sequences improved by gradient ascent on their return.

    A step that does not raise the return, or raises the violation, is undone, and the step size is halved.

    Args:
        scorer: Scores sequences.
        state: Start of the plans, rows (batch,).
        actions: Sequences, (batch, horizon, action).
        num_steps: Number of gradient steps.
        step_size: Largest change of an action in the first step, in action units.
        space: Keeps bounds and limits of the actions.

    Returns:
        Sequences (batch, horizon, action) with a return no lower and a violation no higher than before, their returns
        (batch,) and, with constraints, their violations (batch,).

    Raises:
        ValueError: The return is not differentiable in the actions.
    """
    with torch.enable_grad():
        # A tensor made in inference mode cannot take part in a gradient; its clone can.
        rows = scorer.start_rows(tree_map(lambda leaf: leaf.clone(), state), 1)
        current = actions.clone()
        size = torch.full_like(current[:, :1, :1], step_size)
        value, violation, slope = _measure(scorer, rows, current)
        for _ in range(num_steps):
            trial = space.decode(space.encode(space.bounds.clamp(current + size * slope)))
            trial_value, trial_violation, trial_slope = _measure(scorer, rows, trial)
            accept = (trial_value > value) & (trial_violation <= violation)
            accept = accept | (torch.isfinite(trial_value) & ~torch.isfinite(value))
            value = torch.where(accept, trial_value, value)
            violation = torch.where(accept, trial_violation, violation)
            chosen = accept[:, None, None]
            current = torch.where(chosen, trial, current)
            slope = torch.where(chosen, trial_slope, slope)
            size = torch.where(chosen, size, size / 2)
    return current, value, violation if scorer.constraints else None


def _measure(scorer: Scorer, rows: State, actions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns return (batch,), violation (batch,) and gradient (batch, horizon, action) with a largest entry of 1."""
    leaf = actions.detach().requires_grad_()
    scores = scorer.score(rows, leaf[:, None])
    returns = scores.returns[:, 0]
    if not returns.requires_grad:
        raise ValueError("gradient_steps above 0 needs a model that is differentiable in the action")
    (gradient,) = torch.autograd.grad(returns.sum(), leaf)
    gradient = torch.nan_to_num(gradient, posinf=0.0, neginf=0.0)  # such a row is not moved
    slope = gradient / gradient.abs().amax(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(gradient.dtype).tiny)
    violation = torch.zeros_like(returns) if scores.violations is None else scores.violations[:, 0]
    return returns.detach(), violation.detach(), slope
