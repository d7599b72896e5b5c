"""The nominal trajectory of a plan, and how a policy holds a body on it.

A plan that was made for a predicted state is executed where the world has come to instead. What the policy does
differently at these two states is a feedback law that somebody has learned already: added to the planned action it
answers what the plan could not foresee, and adds nothing where the world goes as imagined. Optimal control knows the
form, `u = u_plan + pi(x) - pi(x_plan)`, with a linear law (Tassa et al. 2012, "Synthesis and stabilization of complex
behaviors through online trajectory optimization", equation 8).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import Model, State, take_step


class NominalTrajectory:
    """The states that a plan expects, imagined as far as they are asked for.

    Args:
        model: What imagines.
        start: Where the plan starts, rows (batch,).
        actions: The plan, (batch, horizon, action).
    """

    def __init__(self, model: Model, start: State, actions: Tensor) -> None:
        self.model, self.actions = model, actions
        self._states = [start]

    def state_at(self, age: int) -> State:
        """The state that the plan expects after `age` of its actions, rows (batch,)."""
        while len(self._states) <= age:
            following, _ = take_step(self.model, self._states[-1], self.actions[:, len(self._states) - 1])
            self._states.append(following)
        return self._states[age]

    def correct(self, age: int, state: State, policy: Callable[[State], Tensor]) -> Tensor:
        """The plan's action of this age, (batch, action), and what the policy does differently here.

        Args:
            age: Index of the action.
            state: Where each environment is believed to be instead, rows (batch,).
            policy: Gives the mode (rows, action).

        Returns:
            Actions, to be kept within the bounds by the caller; where the policy is not finite, the plan's own.
        """
        both = tree_map(lambda here, there: torch.cat([here, there]), state, self.state_at(age))
        here, there = policy(both).chunk(2)
        answer = here - there
        planned = self.actions[:, age]
        return planned + torch.where(torch.isfinite(answer), answer, 0.0)
