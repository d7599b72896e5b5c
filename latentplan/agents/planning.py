"""An agent that decides by planning in the latent at every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.base import ModelAgent
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel
from latentplan.objectives.expression import Expression
from latentplan.planning import ModelPredictiveController, make_planner
from latentplan.planning.objectives import Constraint, Term


class PlanningAgent(ModelAgent):
    """Decides by CEM-MPC in the latent, and executes only the first action of each plan.

    With `planner.surprise_limit` the actor decides where the newest frame surprised the model: what it imagines from
    there is to be trusted less than what it learned there.

    Attributes:
        was_surprised: Whether that is why the latest action was the actor's, in the first environment.

    Args:
        model: The world model.
        config: Settings it was trained with.
        discount: Per decision, as learned.
        planner: Settings of the search; None takes those of `config`.
        noise_std: Of exploration noise.
        noise_correlation: Of exploration noise, between decisions.
        seed: Of the agent's own random stream.
    """

    def __init__(
        self,
        model: WorldModel,
        config: Config,
        discount: float,
        *,
        planner: PlannerConfig | None = None,
        noise_std: float = 0.0,
        noise_correlation: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__(model, config, noise_std=noise_std, noise_correlation=noise_correlation, seed=seed)
        settings = planner or config.planner
        self.surprise_limit, self.was_surprised = settings.surprise_limit, False
        search = make_planner(settings.method, settings, action_dim=model.action_dim, discount=discount)
        self.controller = ModelPredictiveController(search, self.imagined, generator=self.generator)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the past and the last plan, everywhere or where mask (batch,) is true."""
        super().reset(mask)
        self.controller.reset(None if self.state is None else self._forget)

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """Changes what is planned for, from the next action on; the last plan stays where the search starts.

        Args:
            objective: An expression such as `"speed -> 2.0 and height > 1.1"`, or a term of
                `latentplan.planning.objectives`; None is what the agent was trained for.
            constraints: Inequalities such as `"cart < 0.5"`, separated by `;`, or functions of imagined rollouts.

        Raises:
            UserError: The text is no expression, or is about what this agent does not predict.
        """
        self.controller.set_objective(*self._plan_goals(objective, constraints, self.controller.planner))

    @torch.no_grad()
    def imagine(self) -> np.ndarray | None:
        """The decoded last state of the plan that is followed, uint8 (32, 32, 3), of the first environment."""
        if self.controller.plan is None or self.state is None or self.was_surprised:
            return None
        return self._picture(self.state, self.controller.plan.actions)

    def planned_action(self) -> np.ndarray | None:
        """Mean and std of the last plan's first action side by side, float32 (batch, 2 action); None without a plan.

        Zeros where the search found nothing finite.
        """
        plan = self.controller.plan
        if plan is None:
            return None
        planned = torch.cat(plan.action_distribution(self.controller.planner.min_std), -1)
        return planned.masked_fill(plan.info["is_fallback"][:, None], 0.0).float().cpu().numpy()

    def _choose(self, state: State) -> Tensor:
        with self.model.trunk_precision():
            action = self.controller.act(state)
        self.last_source = self.controller.source
        self.was_surprised = False
        if self.surprise_limit is None or self.controller.objective is not None or self.controller.constraints:
            return action
        is_surprised = self.imagined.surprise(state) > self.surprise_limit
        if not bool(is_surprised.any()):
            return action
        if bool(is_surprised[0]):
            self.was_surprised, self.last_source = self.last_source == "plan", "actor"
        return torch.where(is_surprised[:, None], self.imagined.policy(state), action)
