"""The agent that acts by the actor, and plans the doubtful decisions within a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.base import Seen, frame_of
from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel
from latentplan.models.encoder import Observation
from latentplan.objectives.expression import Expression
from latentplan.planning.objectives import Constraint, Term, apply_view

SIGNALS = ("mismatch", "value", "both", "random")
GAP_STEPS = 2  # one model step costs about as much as encoding the frame
GAIN = 0.1  # change of the threshold per unit of excess planning, in standard deviations of the signal
HEAD_START = 1.0  # initial threshold above the normal quantile: saves 1 / GAIN plans, see `GatedAgent`


class GatedAgent(PlanningAgent):
    """Acts by the actor; plans at an episode's first decision, and wherever a signal of doubt exceeds a threshold.

    The signals of a decision:

        mismatch    KL(posterior || prior) of the latent at this frame: distance of the frame from the prediction;
        value       |V(s) - (return of two imagined actor steps + discounted V)|: contradiction between the value head
                    and the model's rollout of the actor;
        both        the larger of mismatch and value;
        random      standard normal noise: the baseline, which plans as often at random decisions.

    Mismatch and value are skewed, so their logarithms are standardised by a running mean and standard deviation. After
    each decision the threshold moves by `threshold += 0.1 * (planned - planning_budget)`, also after the first decision
    of an episode. After N decisions the share of planned decisions therefore differs from the budget by exactly the
    total change of the threshold divided by 0.1 N, for any signal (Gibbs and Candes 2021, "Adaptive conformal
    inference", proposition 4.1). The threshold starts one standard deviation above the normal quantile: while the
    threshold falls to the quantile, the agent makes ten plans fewer than the budget allows, as a reserve for moments at
    which many decisions must be planned. A reset does not change the threshold, which is calibrated to the agent and
    not to an episode.

    Doubtful decisions never raise the planned share of all decisions above the budget: if the budget does not cover all
    doubtful decisions, the environments with the highest signal plan first. Three kinds of decisions are planned even
    beyond the budget, and later decisions save as many plans: first decisions of an episode, decisions after the end of
    the last plan under an untrained goal, and decisions with a NaN signal.

    While the actor acts, the last plan ages: the next search starts from the plan shifted by the decisions in between,
    or without a warm start after the end of the plan. The actor was trained on the task's reward. Under another
    objective or a constraint (an untrained goal) the agent therefore executes the rest of the last plan instead of the
    actor's action, and plans again after the end of the plan. The signal (except `random`) is then the sum of the
    mismatches since the last search, which grows faster where the frames differ more from the rollout. A goal that the
    model learned to pursue (`conditioned`) has its own actor and value head, which replace the task's. The
    environments of a batch are gated one by one, and share the threshold.

    Attributes:
        last_source: Origin of the most recent action: "plan", "tail" (the rest of an older plan) or "actor"; a list
            with one origin per environment for a batch of frames.
        planned_fraction: Share of decisions so far at which a search was requested; 0 before the first decision.

    Args:
        model: The world model.
        config: Settings the model was trained with.
        discount: Discount per decision, as learned.
        planning_budget: Share of decisions to plan, in [0, 1]: 1 plans every decision, 0 only first decisions.
        signal: `mismatch`, `value`, `both` or `random`.
        planner: Settings of the search; None takes the settings in `config`.
        seed: Seed of the agent's own random stream.

    Raises:
        ValueError: The budget lies outside [0, 1], or the signal is unknown.
    """

    def __init__(
        self,
        model: WorldModel,
        config: Config,
        discount: float,
        *,
        planning_budget: float = 0.3,
        signal: str = "both",
        planner: PlannerConfig | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(model, config, discount, planner=planner, seed=seed)
        if not 0.0 <= planning_budget <= 1.0:
            raise ValueError(f"planning_budget must lie in [0, 1], got {planning_budget}")
        if signal not in SIGNALS:
            raise ValueError(f"signal must be one of {', '.join(SIGNALS)}, got {signal!r}")
        self.planning_budget, self.signal, self.discount = planning_budget, signal, discount
        self._signal_names = ("mismatch", "value") if signal == "both" else (signal,)
        self.threshold = HEAD_START + _normal_threshold(planning_budget, len(self._signal_names))
        self._scales = {name: RunningScale() for name in (*self._signal_names, "drift")}
        self._num_planned = self._num_decisions = 0
        self._actor_model: Any = self.imagined  # under a learned goal: the model with the actor and value of the goal
        self._mismatch: Tensor | None = None
        self._drift: Tensor | None = None
        self._is_first: Tensor | None = None

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """See `PlanningAgent.set_objective`."""
        super().set_objective(objective, constraints)
        self._actor_model, _ = apply_view(self.imagined, self.controller.objective)

    @property
    def planned_fraction(self) -> float:
        """Share of decisions so far at which a search was requested; 0 before the first decision."""
        return self._num_planned / self._num_decisions if self._num_decisions else 0.0

    @property
    def effective_surprise_limit(self) -> None:
        """None, because a gated agent ignores `planner.surprise_limit`: it compares surprise with its own threshold."""
        return None

    def plan_actions(self) -> Tensor | None:
        """The first environment's plan, (1, horizon, action); None without a new plan."""
        source = self.last_source if isinstance(self.last_source, str) else self.last_source[0]
        return super().plan_actions() if source == "plan" else None

    def act(self, frame: Seen) -> np.ndarray:
        """The action in [-1, 1], float32 (action,) or (batch, action), for uint8 frame(s); see `ModelAgent.act`."""
        action = super().act(frame)
        if frame_of(frame).ndim == 3:
            self.last_source = self.last_source[0]
        return action

    def _update_belief(self, frames: Tensor | Observation) -> State:
        if self.state is None:
            self._is_first, self._drift = torch.ones(len(frames), dtype=torch.bool, device="cpu"), None
        elif self._is_reset is None:
            self._is_first = torch.zeros(len(frames), dtype=torch.bool, device="cpu")
        else:
            self._is_first = self._is_reset.cpu()
        return super()._update_belief(frames)

    def _infer(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None
    ) -> State:
        belief, mismatch = self._frame_functions.infer_and_compare(state, action, frames, is_first)
        self._mismatch = mismatch.unflatten(0, (-1, self._turns)).mean(1)
        self._drift = self._mismatch if self._drift is None else self._drift + self._mismatch
        return belief

    def _choose(self, state: State) -> Tensor:
        assert self._is_first is not None and self._drift is not None
        action = self._act_by_actor(state)
        must_plan, is_tail = self._is_first, torch.zeros_like(self._is_first)
        if self._is_goal_untrained:
            planned, is_tail = self.controller.next_actions() or (action, is_tail)
            must_plan = must_plan | ~is_tail
            action = torch.where(is_tail[:, None].to(action.device), planned.to(action.dtype), action)
        is_planned = must_plan | self._is_doubtful(state, action, must_plan)
        has_plan = is_planned
        if bool(is_planned.any()):
            with self.model.trunk_precision():
                planned = self.controller.act_where(state, is_planned, self._last_action())
            plan = self.controller.plan
            assert plan is not None
            has_plan = is_planned & ~plan.info["is_fallback"].cpu()
            if not torch.equal(has_plan, is_planned):
                plan.warn_of_failures()
            kept = has_plan[is_planned].to(action.device)
            action[has_plan.to(action.device)] = planned[kept].to(action.dtype)
        else:
            self.controller.skip()
        self._count_decisions(is_planned, has_plan, is_tail)
        self._drift = torch.where(is_planned.to(self._drift.device), 0.0, self._drift)
        return action

    @property
    def _is_goal_untrained(self) -> bool:
        """Whether an objective or a constraint is set for which the model has no trained actor."""
        is_untrained = self.controller.objective is not None and self._actor_model is self.imagined
        return is_untrained or bool(self.controller.constraints)

    def _act_by_actor(self, state: State) -> Tensor:
        """The mode of the actor of the task, or of the goal where the model learned to pursue it."""
        is_task_actor = self._actor_model is self.imagined
        return super()._act_by_actor(state) if is_task_actor else self._actor_model.policy(state)

    def _is_doubtful(self, state: State, action: Tensor, must_plan: Tensor) -> Tensor:
        """Whether the signal exceeds the threshold and the budget allows for a plan, (batch,) bool on the CPU.

        Args:
            state: The belief about each environment.
            action: The action that is executed without a new plan, (batch, action).
            must_plan: Environments that are planned whatever their signal, (batch,) bool; these signals do not enter
                the running statistics.
        """
        scores = [
            self._scales[name].standardise(values.cpu(), ~must_plan)
            for name, values in self._measure_signals(state, action).items()
        ]
        score = torch.stack(scores).amax(0)  # NaN if any is NaN
        is_doubtful = (score > self.threshold) & ~must_plan
        left = self.planning_budget * (self._num_decisions + len(action)) - self._num_planned - int(must_plan.sum())
        ranks = score.masked_fill(~is_doubtful, -math.inf).argsort(descending=True).argsort()
        return score.isnan() | (is_doubtful & (ranks < math.floor(left + 1e-9)))

    def _measure_signals(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """The signals of a decision by name, (batch,) each; logarithms, except for `random`."""
        if "random" in self._signal_names:
            return {
                "random": torch.randn(
                    len(action), generator=self.generator, device=self.generator.device, dtype=torch.float32
                )
            }
        assert self._mismatch is not None and self._drift is not None
        if self._is_goal_untrained:
            return {"drift": self._drift.clamp_min(1e-6).log()}
        signals = {}
        if "mismatch" in self._signal_names:
            signals["mismatch"] = self._mismatch.clamp_min(1e-6).log()
        if "value" in self._signal_names:
            signals["value"] = self._value_gap(state, action).clamp_min(1e-6).log()
        return signals

    def _value_gap(self, state: State, action: Tensor) -> Tensor:
        """Difference between the value of a state and the return of the actor's rollout from the state, (batch,)."""
        with self.model.trunk_precision():
            gap, weight = -self._actor_model.value(state), 1.0
            for step in range(GAP_STEPS):
                if step > 0:
                    action = self._act_by_actor(state)
                state, reward = self._actor_model.fast_step(state, action)
                gap, weight = gap + weight * reward, weight * self.discount
            return (gap + weight * self._actor_model.value(state)).abs()

    def _count_decisions(self, is_planned: Tensor, has_plan: Tensor, is_tail: Tensor) -> None:
        num_planned, num = int(is_planned.sum()), len(is_planned)
        self._num_planned += num_planned
        self._num_decisions += num
        self.threshold += GAIN * (num_planned - num * self.planning_budget)
        self.last_source = [
            "plan" if planned else "tail" if tail else "actor"
            for planned, tail in zip(has_plan.tolist(), is_tail.tolist(), strict=True)
        ]


class RunningScale:
    """Standardises values by the running mean and standard deviation of earlier values (Welford 1962).

    Attributes:
        num: Number of values so far.
        mean: Mean of the values so far.
    """

    def __init__(self) -> None:
        self.num, self.mean, self._squares = 0, 0.0, 0.0

    @property
    def std(self) -> float:
        """Standard deviation of the values so far; 0 before there are two different values."""
        return math.sqrt(self._squares / self.num) if self.num else 0.0

    def standardise(self, values: Tensor, counts: Tensor) -> Tensor:
        """Values (batch,) in standard deviations from the mean, 0 while the deviation is 0; then updates both.

        Args:
            values: The values, (batch,); NaN and infinity are returned unchanged and do not enter the statistics.
            counts: Values that enter the statistics, (batch,) bool.
        """
        scores = values - self.mean if self.num else values * 0.0
        scores = scores / self.std if self.std > 0.0 else scores * 0.0
        for value in values[counts & torch.isfinite(values)].tolist():
            self.num += 1
            distance = value - self.mean
            self.mean += distance / self.num
            self._squares += distance * (value - self.mean)
        return scores


def _normal_threshold(budget: float, num_signals: int) -> float:
    """The threshold that the largest of `num_signals` standard normal signals exceeds with probability `budget`."""
    if budget in (0.0, 1.0):
        return math.inf if budget == 0.0 else -math.inf
    return NormalDist().inv_cdf((1.0 - budget) ** (1.0 / num_signals))
