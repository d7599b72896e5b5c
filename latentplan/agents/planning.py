"""The agent that searches a plan in the world model at every decision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.base import ModelAgent
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel
from latentplan.models.symmetry import flat, mean_over_turns
from latentplan.objectives.expression import Expression
from latentplan.planning import CEMPlanner, ModelPredictiveController, Planner, make_planner
from latentplan.planning.objectives import Constraint, Term


def make_search(model: WorldModel, settings: PlannerConfig, discount: float) -> Planner:
    """The planner of these settings for a model's actions.

    Args:
        model: The world model.
        settings: Method and options of the search.
        discount: Discount per decision, as learned.
    """
    problem: dict[str, Any] = {"action_dim": model.action_dim, "discount": discount}
    if model.has_choices:
        problem["action_choices"] = model.spaces.action_choices
    return make_planner(settings.method, settings, **problem)


class PlanningAgent(ModelAgent):
    """Plans by CEM-MPC in the latent at every decision, and executes only the first action of each plan.

    With `planner.surprise_limit` the actor replaces the plan where the newest frame differs from the model's prediction
    by more than the limit: rollouts from such a state are less reliable than the actor.

    Attributes:
        was_surprised: Whether the latest action of the first environment is the actor's because the frame exceeded the
            limit.

    Args:
        model: The world model.
        config: Settings the model was trained with.
        discount: Discount per decision, as learned.
        planner: Settings of the search; None takes the settings in `config`.
        noise_std: Standard deviation of exploration noise.
        noise_correlation: Correlation of exploration noise between one decision and the next, in [0, 1).
        seed: Seed of the agent's own random stream.
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
        search = make_search(model, settings, discount)
        self.controller = ModelPredictiveController(search, self.imagined, generator=self.generator)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forgets past and last plan of all environments, or only of environments where mask (batch,) is true."""
        super().reset(mask)
        self.controller.reset(None if self.state is None else self._is_reset)

    def memory(self) -> dict[str, Any]:
        """As `ModelAgent.memory`, with the last plan."""
        return super().memory() | {"controller": self.controller.memory()}

    def set_memory(self, memory: dict[str, Any]) -> None:
        """As `ModelAgent.set_memory`, with the last plan."""
        super().set_memory(memory)
        self.controller.set_memory(memory["controller"], self.model.device)

    @property
    def effective_surprise_limit(self) -> float | None:
        """Surprise in nats above which the actor acts; None without a limit, and with an objective or constraints."""
        has_goals = self.controller.objective is not None or bool(self.controller.constraints)
        return None if has_goals else self.surprise_limit

    def weigh_ends(self) -> None:
        """From the next decision on, plans weigh rewards by the probability that the episode goes on."""
        planner = self.controller.planner
        if isinstance(planner, CEMPlanner):
            self.controller.planner = replace(planner, use_continues=True)

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """Sets the objective and the constraints of all plans from the next decision on.

        The next search still starts from the last plan.

        Args:
            objective: An expression such as `"speed -> 2.0 and height > 1.1"`, or a term of
                `latentplan.planning.objectives`; None stands for the reward that the agent was trained on.
            constraints: Inequalities such as `"cart < 0.5"`, separated by `;`, or functions of imagined rollouts.

        Raises:
            UserError: The text is no expression, or names a quantity that the agent does not predict.
        """
        self.controller.set_objective(*self._build_goals(objective, constraints, self.controller.planner))

    def plan_actions(self) -> Tensor | None:
        """The first environment's plan, (1, horizon, action); None where the actor acted."""
        if self.controller.plan is None or self.was_surprised:
            return None
        return self.controller.plan.actions[:1]

    def _choose(self, state: State) -> Tensor:
        with self.model.trunk_precision():
            action = self.controller.act(state, self._last_action())
        self.last_source = self.controller.source
        if self.controller.plan is not None:
            self.controller.plan.warn_of_failures()
        self.was_surprised = False
        limit = self.effective_surprise_limit
        if limit is None:
            return action
        surprise = mean_over_turns(self._frame_functions.surprise(flat(state)), state)
        is_surprised = surprise > limit
        if not bool(is_surprised.any()):
            return action
        if bool(is_surprised[0]):
            self.was_surprised, self.last_source = self.last_source == "plan", "actor"
        return torch.where(is_surprised[:, None], self._act_by_actor(state), action)
