"""An agent that acts by its actor, and plans where that is unsure: the planner where it pays, within a budget."""

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
from latentplan.planning.objectives import Constraint, Term, seen_for

SIGNALS = ("mismatch", "value", "both", "random")
GAP_STEPS = 2  # a step of imagination costs as much as seeing the frame
GAIN = 0.1  # of the threshold per decision, in standard deviations of the signal
HEAD_START = 1.0  # of the threshold over the normal quantile: ten plans are saved early for when many are due at once


class GatedAgent(PlanningAgent):
    """Acts by the actor; plans at an episode's first decision, and wherever a signal of doubt exceeds a threshold.

    The signals of a decision:

        mismatch    KL(posterior || prior) of the latent at this frame: how far the world left the model's path;
        value       |V(s) - (imagined return of two actor steps + discounted V)|: how far the critic contradicts what
                    the model says of the actor;
        both        the larger of the two;
        random      standard normal noise: the baseline that plans as often, anywhere.

    Their logarithms, because both are skewed, are standardised by running mean and standard deviation. The threshold
    follows the budget by `threshold += 0.1 * (planned - planning_budget)` after each decision, the first ones of
    episodes included. After N decisions the share of planned ones therefore differs from the budget by exactly the way
    of the threshold divided by 0.1 N, whatever the signal does (the argument of Gibbs and Candes 2021, "Adaptive
    conformal inference", proposition 4.1). It starts one standard deviation above the normal quantile, so that the ten
    plans which are made too few on its way down are there when many are due at once, and lives through resets:
    calibration belongs to the agent, not to an episode.

    Doubt never takes the planned share of all decisions beyond the budget: where it would, the most doubtful
    environments plan. What must be planned is planned all the same, and saved later: first decisions, what no plan is
    left for, and where a signal is not a number.

    While the actor acts the last plan ages: the next search starts from it shifted by the decisions in between, and
    cold when it has run out. An actor knows nothing of an objective or a constraint that was set since: then the last
    plan goes on where none is made, and where it has run out one is made. In doubt is then what the plan did not
    foresee: the signal (but for `random`) is the sum of the mismatches since it was made, which grows until the next
    search, the faster the less the world goes as imagined. A goal that the model has learned to pursue (`conditioned`)
    has an actor and a value of its own, which then stand for those of the task. Environments of a batch are gated one
    by one, and share the threshold.

    Attributes:
        last_source: "plan", "tail" (of an older plan) or "actor", of the most recent decision; a list of these for
            several frames.
        planned_fraction: Share of decisions so far at which a search was asked for, in time or not; 0 before the first.

    Args:
        model: The world model.
        config: Settings it was trained with.
        discount: Per decision, as learned.
        planning_budget: Share of decisions to plan, in [0, 1]; 1 plans always, 0 only where an episode begins.
        signal: `mismatch`, `value`, `both` or `random`.
        planner: Settings of the search; None takes those of `config`.
        seed: Of the agent's own random stream.

    Raises:
        ValueError: The budget or the signal is not one of those.
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
        self._acting: Any = self.imagined  # or, of a learned goal, what shows its actor and value
        self._mismatch: Tensor | None = None
        self._drift: Tensor | None = None
        self._is_first: Tensor | None = None

    def set_objective(
        self, objective: str | Expression | Term | None = None, constraints: str | Sequence[Constraint] = ()
    ) -> None:
        """See `PlanningAgent.set_objective`."""
        super().set_objective(objective, constraints)
        self._acting, _ = seen_for(self.imagined, self.controller.objective)

    @property
    def planned_fraction(self) -> float:
        """Share of decisions so far at which a search was asked for, in time or not; 0 before the first."""
        return self._num_planned / self._num_decisions if self._num_decisions else 0.0

    @torch.no_grad()
    def imagine(self) -> np.ndarray | None:
        """The picture that the present plan leads to, uint8 (32, 32, 3), of the first environment; None without one."""
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
        """Whether something is pursued that no actor knows of."""
        is_unknown = self.controller.objective is not None and self._acting is self.imagined
        return is_unknown or bool(self.controller.constraints)

    def _is_doubtful(self, state: State, action: Tensor, is_due: Tensor) -> Tensor:
        """Whether the signal exceeds the threshold and the budget allows for a plan, (batch,) bool on the CPU.

        Args:
            state: Where each environment is.
            action: What is done without a plan, (batch, action).
            is_due: Where a plan is made anyway, (batch,) bool: nothing is learned of the signal there.
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
        """What the critic says of a state, against what the model says of the actor's way from there: (batch,)."""
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
    """Mean and standard deviation of what was seen so far (Welford 1962), to standardise what comes next."""

    def __init__(self) -> None:
        self.num, self.mean, self._squares = 0, 0.0, 0.0

    @property
    def std(self) -> float:
        """Standard deviation so far; 0 before there are two different values."""
        return math.sqrt(self._squares / self.num) if self.num else 0.0

    def standardise(self, values: Tensor, counts: Tensor) -> Tensor:
        """Values (batch,) in standard deviations from the mean, 0 while there is no deviation; then they are learned.

        Args:
            values: NaN and infinity stay what they are, and are not learned.
            counts: Which of them are learned, (batch,) bool.
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
    """What the largest of so many independent standard normal numbers exceeds with the budget's probability."""
    if budget in (0.0, 1.0):
        return math.inf if budget == 0.0 else -math.inf
    return NormalDist().inv_cdf((1.0 - budget) ** (1.0 / num_signals))
