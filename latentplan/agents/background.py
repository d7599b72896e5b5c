"""An agent for worlds that do not wait: it acts at once, and plans beside the control loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.base import ModelAgent
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel
from latentplan.models.symmetry import TurnedModel
from latentplan.objectives.expression import Expression
from latentplan.planning import BackgroundPlanner, Plan, PlanExecutor, Planner, PlanScheduler, make_planner
from latentplan.planning.objectives import Constraint, Term


@dataclass(frozen=True)
class LatentPlanner:
    """A planner that searches in a world model at the precision of its trunk, as `PlanningAgent` does."""

    search: Planner

    def plan(self, model: WorldModel | TurnedModel, state: State, previous: Plan | None = None, **options: Any) -> Plan:
        """See `CEMPlanner.plan`."""
        with model.trunk_precision():
            return self.search.plan(model, state, previous, **options)


class BackgroundAgent(ModelAgent):
    """Takes each action from the newest plan that is due, or from the actor, while the next plan is searched beside.

    A decision costs no more than seeing the frame and a few steps of the model. Several environments share each plan's
    search, so `reset` drops the plans of all of them, whatever the mask. Close it, or use it in a `with` block.

    Attributes:
        last_source: Where the most recent action came from: "plan", "tail" (of a plan whose successor is late) or
            "actor".
        plan_age: Decisions between the one that the plan was made for and the most recent; None with the actor.
        scheduler: The rules, with the buffer and the executor; see `PlanScheduler`.

    Args:
        model: The world model; a process works with a copy of it, made now.
        config: Settings it was trained with.
        discount: Per decision, as learned.
        planner: Settings of the search; None takes those of `config`.
        seed: Of the agent's own random stream.
        worker: Where plans are searched: `process` or `thread` (for models on a GPU).
        max_age: See `PlanBuffer`.
        fresh_ticks: See `PlanBuffer`; None follows the measured latency.
        make_executor: Makes what computes plans, of planner and model; None takes `BackgroundPlanner`.
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
        search = make_planner(settings.method, settings, action_dim=model.action_dim, discount=discount)
        if make_executor is None:
            executor: PlanExecutor = BackgroundPlanner(LatentPlanner(search), self.imagined, worker=worker)
        else:
            executor = make_executor(LatentPlanner(search), self.imagined)
        self.scheduler = PlanScheduler(
            search, self.imagined, executor, max_age=max_age, fresh_ticks=fresh_ticks, generator=self.generator
        )
        self.plan_age: int | None = None

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the past, everywhere or where mask (batch,) is true, and all plans."""
        super().reset(mask)
        self.scheduler.reset()

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """Changes what plans asked for from now on pursue; those made before are followed until these come.

        The actor, which acts where no plan is due, goes on with what it was trained for.

        Args:
            objective: See `PlanningAgent.set_objective`.
            constraints: See `PlanningAgent.set_objective`.

        Raises:
            UserError: The text is no expression, or is about what this agent does not predict.
            TypeError: A term cannot be sent to the process that plans.
        """
        self.scheduler.set_objective(*self._plan_goals(objective, constraints, self.scheduler.planner))

    @torch.no_grad()
    def imagine(self) -> np.ndarray | None:
        """The decoded last state of the plan in use, uint8 (32, 32, 3), of the first environment; None without one."""
        remaining = self.scheduler.buffer.remaining(self.scheduler.tick - 1)
        if remaining is None or self.state is None:
            return None
        return self._picture(self.state, remaining)

    def wait_until_ready(self, seconds: float = 60.0) -> bool:
        """Wait until plans can be searched at once, at most so long; whether they can (or the worker has failed)."""
        executor = self.scheduler.executor
        return not isinstance(executor, BackgroundPlanner) or executor.wait_until_ready(seconds)

    def close(self) -> None:
        """End the worker; the agent goes on with what is left of its plan, then with the actor."""
        if isinstance(self.scheduler.executor, BackgroundPlanner):
            self.scheduler.executor.close()

    def __enter__(self) -> BackgroundAgent:
        """Nothing but the agent itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def _choose(self, state: State) -> Tensor:
        with self.model.trunk_precision():
            decision = self.scheduler.decide(state)
        self.last_source, self.plan_age = decision.source, decision.age
        return decision.action
