"""The agent that acts by the actor, and plans at doubtful decisions within a budget."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.planning import PlanningAgent
from latentplan.config import Config, PlannerConfig
from latentplan.models import State, WorldModel, kl_divergence
from latentplan.models.symmetry import flat, mean_over_turns
from latentplan.objectives.expression import Expression
from latentplan.planning.objectives import Constraint, Term, apply_view

SIGNALS = ("mismatch", "value", "both", "random")
GAP_STEPS = 2  # one model step costs about as much as encoding the frame
GAIN = 0.1  # change of the threshold per unit of excess planning, in standard deviations of the signal
HEAD_START = 1.0  # initial threshold above the normal quantile: saves ten plans for times when many are due at once


class GatedAgent(PlanningAgent):
    """Acts by the actor; plans at an episode's first decision, and wherever a signal of doubt exceeds a threshold.

    The signals of a decision:

        mismatch    KL(posterior || prior) of the latent at this frame: how far the frame is from the prediction;
        value       |V(s) - (return of two imagined actor steps + discounted V)|: how far the value head contradicts
                    the model's rollout of the actor;
        both        the larger of mismatch and value;
        random      standard normal noise: the baseline, which plans as often at random decisions.

    Mismatch and value are skewed, so their logarithms are standardised by a running mean and standard deviation. After
    each decision the threshold moves by `threshold += 0.1 * (planned - planning_budget)`; first decisions of episodes
    count too. After N decisions the share of planned decisions therefore differs from the budget by exactly the total
    change of the threshold divided by 0.1 N, whatever the signal does (Gibbs and Candes 2021, "Adaptive conformal
    inference", proposition 4.1). The threshold starts one standard deviation above the normal quantile: while it falls
    to the quantile ten plans are saved, which the agent spends when many are due at once. The threshold outlives
    resets, because it is calibrated to the agent and not to an episode.

    Doubt never takes the planned share of all decisions beyond the budget: where it would, the environments with the
    highest signal plan first. Three kinds of decisions are planned even beyond the budget, and later decisions save
    them: first decisions, decisions without a plan left under another objective, and decisions whose signal is NaN.

    While the actor acts the last plan ages: the next search starts from the plan shifted by the decisions in between,
    and starts cold once the plan has run out. The actor was trained on the task's reward. Under another objective or a
    constraint the agent therefore executes the rest of the last plan instead of the actor's action, and plans anew when
    that has run out. The signal (but for `random`) is then the sum of the mismatches since the plan was made, which
    grows until the next search, and faster where the world differs more from the rollout. A goal that the model
    learned to pursue (`conditioned`) has an actor and a value head of its own; these replace the task's. Environments
    of a batch are gated one by one, and share the threshold.

    Attributes:
        last_source: Origin of the most recent action: "plan", "tail" (the rest of an older plan) or "actor"; a list of
            these for a batch of frames.
        planned_fraction: Share of decisions so far at which a search was requested; 0 before the first decision.

    Args:
        model: The world model.
        config: Settings the model was trained with.
        discount: Discount per decision, as learned.
        planning_budget: Share of decisions to plan, in [0, 1]: 1 plans every decision, 0 only first decisions.
        signal: `mismatch`, `value`, `both` or `random`.
        planner: Settings of the search; None takes those of `config`.
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
        self._names = ("mismatch", "value") if signal == "both" else (signal,)
        self.threshold = HEAD_START + _normal_threshold(planning_budget, len(self._names))
        self._scales = {name: RunningScale() for name in (*self._names, "drift")}
        self._num_planned = self._num_decisions = 0
        self._acting: Any = self.imagined  # for a learned goal, the model with the actor and value of that goal
        self._mismatch: Tensor | None = None
        self._drift: Tensor | None = None
        self._is_first: Tensor | None = None

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """See `PlanningAgent.set_objective`."""
        super().set_objective(objective, constraints)
        self._acting, _ = apply_view(self.imagined, self.controller.objective)

    @property
    def planned_fraction(self) -> float:
        """Share of decisions so far at which a search was requested; 0 before the first decision."""
        return self._num_planned / self._num_decisions if self._num_decisions else 0.0

    @torch.no_grad()
    def imagine(self) -> np.ndarray | None:
        """The decoded end of the first environment's new plan, uint8 (32, 32, 3); None where none was made."""
        source = self.last_source if isinstance(self.last_source, str) else self.last_source[0]
        return super().imagine() if source == "plan" else None

    def act(self, frame: np.ndarray) -> np.ndarray:
        """The action in [-1, 1], float32 (action,) or (batch, action), for uint8 frame(s); see `ModelAgent.act`."""
        action = super().act(frame)
        if frame.ndim == 3:
            self.last_source = self.last_source[0]
        return action

    def _believe(self, frames: Tensor) -> State:
        if self.state is None:
            self._is_first, self._drift = torch.ones(len(frames), dtype=torch.bool), None
        else:
            self._is_first = torch.zeros(len(frames), dtype=torch.bool) if self._forget is None else self._forget.cpu()
        return super()._believe(frames)

    def _see(self, deter: Tensor, frames: Tensor) -> State:
        posterior = self.model.dynamics.posterior(deter, self.model.encoder(frames))
        mismatch = kl_divergence(posterior, self.model.dynamics.prior(deter))
        self._mismatch = mismatch.unflatten(0, (-1, self._turns)).mean(1)
        self._drift = self._mismatch if self._drift is None else self._drift + self._mismatch
        return State(deter, posterior.mean)

    def _choose(self, state: State) -> Tensor:
        assert self._is_first is not None and self._drift is not None
        is_own = self._acting is self.imagined
        mode = self.model.actor(flat(state).features)[0] if is_own else self._acting.policy(state)
        action = mean_over_turns(mode, state) if is_own else mode
        is_due, is_tail = self._is_first, torch.zeros_like(self._is_first)
        if self._is_foreign:
            planned, is_tail = self.controller.next_actions() or (action, is_tail)
            is_due = is_due | ~is_tail
            action = torch.where(is_tail[:, None].to(action.device), planned.to(action.dtype), action)
        is_planned = is_due | self._is_doubtful(state, action, is_due)
        is_found = is_planned
        if bool(is_planned.any()):
            with self.model.trunk_precision():
                planned = self.controller.act_where(state, is_planned)
            plan = self.controller.plan
            assert plan is not None
            is_found = is_planned & ~plan.info["is_fallback"].cpu()
            if not torch.equal(is_found, is_planned):
                plan.warn_of_failures()
            kept = is_found[is_planned].to(action.device)
            action[is_found.to(action.device)] = planned[kept].to(action.dtype)
        else:
            self.controller.skip()
        self._count(is_planned, is_found, is_tail)
        self._drift = torch.where(is_planned.to(self._drift.device), 0.0, self._drift)
        return action

    @property
    def _is_foreign(self) -> bool:
        """Whether an objective or a constraint is set that no actor was trained for."""
        is_unknown = self.controller.objective is not None and self._acting is self.imagined
        return is_unknown or bool(self.controller.constraints)

    def _is_doubtful(self, state: State, action: Tensor, is_due: Tensor) -> Tensor:
        """Whether the signal exceeds the threshold and the budget allows for a plan, (batch,) bool on the CPU.

        Args:
            state: The belief about each environment.
            action: The action that is executed without a new plan, (batch, action).
            is_due: Environments that plan anyway, (batch,) bool: their signals do not enter the running statistics.
        """
        scores = [
            self._scales[name].standardise(values.cpu(), ~is_due)
            for name, values in self._signals(state, action).items()
        ]
        score = torch.stack(scores).amax(0)  # NaN if any is NaN
        is_doubtful = (score > self.threshold) & ~is_due
        left = self.planning_budget * (self._num_decisions + len(action)) - self._num_planned - int(is_due.sum())
        ranks = score.masked_fill(~is_doubtful, -math.inf).argsort(descending=True).argsort()
        return score.isnan() | (is_doubtful & (ranks < math.floor(left + 1e-9)))

    def _signals(self, state: State, action: Tensor) -> dict[str, Tensor]:
        if "random" in self._names:
            return {"random": torch.randn(len(action), generator=self.generator, device=self.generator.device)}
        assert self._mismatch is not None and self._drift is not None
        if self._is_foreign:
            return {"drift": self._drift.clamp_min(1e-6).log()}
        signals = {}
        if "mismatch" in self._names:
            signals["mismatch"] = self._mismatch.clamp_min(1e-6).log()
        if "value" in self._names:
            signals["value"] = self._value_gap(state, action).clamp_min(1e-6).log()
        return signals

    def _value_gap(self, state: State, action: Tensor) -> Tensor:
        """Difference between a state's value and the return of the actor's imagined steps from it, (batch,)."""
        with self.model.trunk_precision():
            gap, weight = -self._acting.value(state), 1.0
            for step in range(GAP_STEPS):
                if step > 0:
                    action = self._acting.policy(state)
                state, reward = self._acting.fast_step(state, action)
                gap, weight = gap + weight * reward, weight * self.discount
            return (gap + weight * self._acting.value(state)).abs()

    def _count(self, is_planned: Tensor, is_found: Tensor, is_tail: Tensor) -> None:
        num_planned, num = int(is_planned.sum()), len(is_planned)
        self._num_planned += num_planned
        self._num_decisions += num
        self.threshold += GAIN * (num_planned - num * self.planning_budget)
        self.last_source = [
            "plan" if found else "tail" if tail else "actor"
            for found, tail in zip(is_found.tolist(), is_tail.tolist(), strict=True)
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
            values: NaN and infinity come back as they are, and do not enter the statistics.
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
    """The level that the largest of `num_signals` standard normal numbers exceeds with probability `budget`."""
    if budget in (0.0, 1.0):
        return math.inf if budget == 0.0 else -math.inf
    return NormalDist().inv_cdf((1.0 - budget) ** (1.0 / num_signals))
