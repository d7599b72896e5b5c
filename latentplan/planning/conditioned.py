"""Goals that a model has learned to pursue.

A goal-conditioned model has a reward, a value and a policy for each goal of a family. To a search it looks like a model
that was trained for nothing but the one goal it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from latentplan.planning.model import Model, require, supports
from latentplan.planning.objectives import Objective, Rollout, Term

View = Callable[[Model], Model]


def conditioned(view: View) -> Objective:
    """The return of a goal that the model has learned to pursue: its reward, and its value of where a rollout ends.

    Given alone, it makes a search see what `view` gives in place of the model: proposals come from the goal's own
    policy, and plans are as long as those for the model's own return. As a part of a sum it is scored in rollouts of
    the model, like every other term.

    Args:
        view: Gives the model as one sees it who pursues this goal: the same states and steps, with the reward, the
            `value` and, if proposals are to come from it, the `policy` of the goal.
    """
    return Objective(partial(_return, view), needs_states=True, view=view)


def seen_for(model: Model, objective: Term | None) -> tuple[Model, Term | None]:
    """What is searched in, and what for: a goal that was learned is the own return (None) of a view of the model."""
    view = objective.view if isinstance(objective, Objective) else None
    if view is None:
        return model, objective
    return (model.shown_as(view) if supports(model, "shown_as") else view(model)), None  # type: ignore[attr-defined]


def _return(view: View, rollout: Rollout) -> Tensor:
    seen = view(rollout.model)
    require(seen, "value", "a learned goal")
    before = (rollout.start, *rollout.states[:-1])
    pairs = zip(before, rollout.actions.unbind(1), strict=True)
    rewards = torch.stack([seen.step(state, action)[1] for state, action in pairs], dim=1).to(rollout.rewards.dtype)
    value: Tensor = seen.value(rollout.last_state).to(rewards.dtype)  # type: ignore[attr-defined]
    return (rewards * rollout.weights[..., :-1]).sum(dim=1) + rollout.weights[..., -1] * value
