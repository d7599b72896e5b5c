"""Gradient ascent on a plan, for models that are differentiable in the action."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import State
from latentplan.planning.search.scorer import Scorer


def ascend(
    scorer: Scorer,
    state: State,
    actions: Tensor,
    *,
    num_steps: int,
    step_size: float,
    bounds: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Sequences moved uphill along the gradient of their return; a step that does not help is undone and halved.

    Args:
        scorer: What a sequence is worth.
        state: Where plans start, rows (batch,).
        actions: Sequences, (batch, horizon, action).
        num_steps: Gradients taken.
        step_size: Largest change of an action in the first step, in action units.
        bounds: Lowest and highest action, each (action,).

    Returns:
        Sequences (batch, horizon, action) that are worth no less and break constraints no more, their returns and,
        when there are constraints, their violations, (batch,).

    Raises:
        ValueError: The return does not depend on the actions in a way that can be differentiated.
    """
    low, high = bounds
    with torch.enable_grad():
        # A state made under inference_mode cannot take part in a gradient; its clone can.
        rows = scorer.start_rows(tree_map(lambda leaf: leaf.clone(), state), 1)
        current = actions.clone()
        size = torch.full_like(current[:, :1, :1], step_size)
        value, violation, slope = _measure(scorer, rows, current)
        for _ in range(num_steps):
            trial = torch.clamp(current + size * slope, low, high)
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
    """Return (batch,), violation (batch,) and the gradient scaled to a largest entry of 1, (batch, horizon, action)."""
    leaf = actions.detach().requires_grad_()
    scores = scorer.score(rows, leaf[:, None])
    returns = scores.returns[:, 0]
    if not returns.requires_grad:
        raise ValueError("gradient_steps above 0 needs a model that is differentiable in the action")
    (gradient,) = torch.autograd.grad(returns.sum(), leaf)
    gradient = torch.nan_to_num(gradient, posinf=0.0, neginf=0.0)  # a broken row stays where it is, alone
    slope = gradient / gradient.abs().amax(dim=(1, 2), keepdim=True).clamp_min(torch.finfo(gradient.dtype).tiny)
    none = torch.zeros_like(returns)
    violation = none if scores.violations is None else scores.violations[:, 0]
    return returns.detach(), violation.detach(), slope
