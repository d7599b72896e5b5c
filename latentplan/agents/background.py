"""The agent for real time: acts without waiting for a search, while a worker searches the next plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.base import ModelAgent
from latentplan.agents.planning import make_search
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel
from latentplan.models.symmetry import TurnedModel
from latentplan.objectives.expression import Expression
from latentplan.planning import BackgroundPlanner, Plan, PlanExecutor, Planner, PlanScheduler
from latentplan.planning.objectives import Constraint, Term


@dataclass(frozen=True)
class LatentPlanner:
    """Searches in a world model at the precision of the model's trunk, as `PlanningAgent` does.

    Attributes:
        search: The planner.
    """

    search: Planner

    def plan(self, model: WorldModel | TurnedModel, state: State, previous: Plan | None = None, **options: Any) -> Plan:
        """See `CEMPlanner.plan`."""
        with model.trunk_precision():
            return self.search.plan(model, state, previous, **options)


class BackgroundAgent(ModelAgent):
    """Takes each action from the newest plan that is due, or from the actor, while a worker searches the next plan.

    A decision costs one update of the belief and a few model steps. All environments of a batch share each
    search, so `reset` drops the plans of all environments, also with a mask. The agent has to be closed: call `close`
    or use a `with` block.

    Attributes:
        last_source: Origin of the most recent action: "plan", "tail" (the rest of a plan whose successor is late) or
            "actor".
        plan_age: Decisions since the first decision of the present plan; None where the actor acted.
        scheduler: Decides when plans are requested and which plan is due; see `PlanScheduler`.

    Args:
        model: The world model; a worker process gets a copy, made by the constructor.
        config: Settings the model was trained with.
        discount: Discount per decision, as learned.
        planner: Settings of the search; None takes the settings in `config`.
        seed: Seed of the agent's own random stream.
        worker: Where plans are searched: in a `process`, or in a `thread` (for models on a GPU).
        max_age: See `PlanBuffer`.
        fresh_ticks: See `PlanBuffer`; None derives it from the measured latency.
        make_executor: Makes the executor that computes plans, from a planner and a model; None takes
            `BackgroundPlanner`.
    """

    def __init__(
        self,
        model: WorldModel,
        config: Config,
        discount: float,
        *,
        planner: PlannerConfig | None = None,
        seed: int = 0,
        worker: str = "process",
        max_age: int | None = None,
        fresh_ticks: int | None = None,
        make_executor: Callable[[LatentPlanner, Any], PlanExecutor] | None = None,
    ) -> None:
        super().__init__(model, config, seed=seed)
        settings = planner or config.planner
        search = make_search(model, settings, discount)
        if make_executor is None:
            executor: PlanExecutor = BackgroundPlanner(LatentPlanner(search), self.imagined, worker=worker)
        else:
            executor = make_executor(LatentPlanner(search), self.imagined)
        self.scheduler = PlanScheduler(
            search, self.imagined, executor, max_age=max_age, fresh_ticks=fresh_ticks, generator=self.generator
        )
        self.plan_age: int | None = None

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forgets the past of all environments, or only of environments where mask (batch,) is true, and all plans."""
        super().reset(mask)
        self.scheduler.reset(None if mask is None else torch.tensor(mask, dtype=torch.bool))

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """Sets the objective and the constraints of all plans requested from now on.

        Plans made before stay in use until the first new plan is due. Where no plan is due, the actor acts for its
        own training reward.

        Args:
            objective: See `PlanningAgent.set_objective`.
            constraints: See `PlanningAgent.set_objective`.

        Raises:
            UserError: The text is no expression, or names a quantity that the agent does not predict.
            TypeError: A term cannot be sent to the process that plans.
        """
        self.scheduler.set_objective(*self._build_goals(objective, constraints, self.scheduler.planner))

    def plan_actions(self) -> Tensor | None:
        """What is left of the first environment's present plan, (1, step, action); None without a plan."""
        remaining = self.scheduler.buffer.remaining(self.scheduler.tick - 1)
        return None if remaining is None else remaining[:1]

    def wait_until_ready(self, seconds: float = 60.0) -> bool:
        """Waits until the worker is ready or has failed, at most `seconds`; returns whether either is so."""
        executor = self.scheduler.executor
        return not isinstance(executor, BackgroundPlanner) or executor.wait_until_ready(seconds)

    def close(self) -> None:
        """Ends the worker; the agent then executes the rest of its plan, and after the plan the actor's actions."""
        if isinstance(self.scheduler.executor, BackgroundPlanner):
            self.scheduler.executor.close()

    def __enter__(self) -> BackgroundAgent:
        """Returns the agent."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Closes the agent."""
        self.close()

    def _choose(self, state: State) -> Tensor:
        with self.model.trunk_precision():
            decision = self.scheduler.decide(state)
        self.last_source, self.plan_age = decision.source, decision.age
        return decision.action
