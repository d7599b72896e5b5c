"""Imagines candidate sequences in the model and scores them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from einops import rearrange, reduce, repeat
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import (
    Model,
    State,
    call_with,
    check_shape,
    check_tensor,
    count_rows,
    has_policy,
    repeat_rows,
    require,
    split_rows,
    supports,
    take_step,
)
from latentplan.planning.objectives import (
    Constraint,
    Objective,
    Rollout,
    Term,
    as_objective,
    name_term,
    predicted_return,
)
from latentplan.planning.search.elites import Scores
from latentplan.planning.search.space import Bounds


@dataclass(frozen=True)
class Scorer:
    """The model, objective and constraints of one search.

    Attributes:
        model: The model in which candidates are imagined.
        objective: Maximised.
        constraints: Each returns a violation (rows,), 0 where the constraint is satisfied.
        discounts: Powers of the discount, (horizon + 1,), in the precision of the returns.
        use_continues: Whether the model's probability that the episode goes on discounts later rewards.
        penalty: Return subtracted per unit of violation; None ranks candidates by violation first.
        generator: Random stream of a model that samples; None for other models.
        find_last_action: Returns the action executed last, (batch, action); None where no plan came before.
    """

    model: Model
    objective: Objective
    constraints: tuple[Objective, ...]
    discounts: Tensor
    use_continues: bool
    penalty: float | None
    generator: torch.Generator | None = None
    find_last_action: Callable[[], Tensor] | None = None

    @classmethod
    def build(
        cls,
        model: Model,
        objective: Term | None,
        constraints: Sequence[Constraint],
        discounts: Tensor,
        *,
        terminal_value: bool | None,
        use_continues: bool,
        penalty: float | None,
        generator: torch.Generator | None = None,
        find_last_action: Callable[[], Tensor] | None = None,
    ) -> Scorer:
        """Returns the scorer of a search; without an objective it scores reward and, by `terminal_value`, value.

        Raises:
            ValueError: The model lacks a method that an option or term needs.
        """
        if use_continues:
            require(model, "continues", "use_continues=True")
        maximised = predicted_return(model, terminal_value) if objective is None else as_objective(objective)
        violations = tuple(as_objective(constraint) for constraint in constraints)
        for term in (maximised, *violations):
            term.check(model)
        streams = (generator, find_last_action)
        return cls(model, maximised, violations, discounts, use_continues, penalty, *streams)

    @property
    def kind(self) -> tuple[str, ...]:
        """What is computed for each candidate, by name: searches of one kind and size take about as long."""
        path = "steps" if self._needs_states or self.use_continues else "rollout"
        return (path, *(name_term(term) for term in (self.objective, *self.constraints)))

    @property
    def num_particles(self) -> int:
        """Number of rollouts of each candidate, set by the objective and the constraints, or else by the model."""
        largest = max(term.num_particles for term in (self.objective, *self.constraints))
        return largest if largest > 1 else getattr(self.model, "num_particles", 1)

    def start_rows(self, state: State, num: int) -> State:
        """Returns the start of `num` candidates per environment, rows (batch sample particle), of a state (batch,)."""
        particles = self.num_particles
        if particles == 1:
            return repeat_rows(state, num)
        versions = (
            self.model.particles(state, particles)  # type: ignore[attr-defined]
            if supports(self.model, "particles")
            else repeat_rows(state, particles)
        )
        pattern = "(batch particle) ... -> (batch num particle) ..."
        return tree_map(lambda leaf: repeat(leaf, pattern, particle=particles, num=num), versions)

    def score(self, start: State, actions: Tensor) -> Scores:
        """Returns the scores of sequences.

        Args:
            start: Result of `start_rows`.
            actions: Candidates, (batch, sample, horizon, action).
        """
        return self.score_rollout(self.imagine(start, actions))

    def imagine(self, start: State, actions: Tensor, *, with_states: bool = False) -> Rollout:
        """Returns the rollouts of sequences.

        Args:
            start: Result of `start_rows`.
            actions: Candidates, (batch, sample, horizon, action).
            with_states: Whether the rollout has its states even if no term needs them.
        """
        batch, particles = actions.shape[0], self.num_particles
        rows = actions.flatten(0, 1)  # (batch sample, horizon, action)
        if particles > 1:
            rows = repeat_rows(rows, particles)
        return self._imagine(start, rows, batch, particles, with_states or self._needs_states)

    def arrange_states(self, rollout: Rollout) -> State:
        """Returns the states of a rollout, leaves (batch, sample, horizon, ...); with particles before the horizon."""
        split = "batch sample particle" if rollout.num_particles > 1 else "batch sample"
        sizes = {"batch": rollout.batch}
        if rollout.num_particles > 1:
            sizes["particle"] = rollout.num_particles
        pattern = f"({split}) horizon ... -> {split} horizon ..."
        return tree_map(lambda *steps: rearrange(torch.stack(steps, dim=1), pattern, **sizes), *rollout.states)

    def propose(self, state: State, num: int, generators: Sequence[torch.Generator], bounds: Bounds) -> Tensor:
        """Returns imagined sequences of the model's policy, its mode first, (batch, num, horizon, action).

        Args:
            state: Start of the plans, rows (batch,).
            num: Number of sequences per environment; all but the first are sampled.
            generators: One stream per environment, so that samples do not depend on the other environments.
            bounds: Bounds of the actions.

        Returns:
            The sequences, within the bounds; not finite where the policy is not.
        """
        batch, horizon = len(generators), len(self.discounts) - 1
        if supports(self.model, "propose"):
            return self._call_propose(state, num, horizon, generators, bounds)
        require(self.model, "policy", "num_policy_samples above 0")
        chosen: list[Tensor] = []

        def choose(step: int, rows: State) -> Tensor:
            action = _policy_actions(self.model, split_rows(rows, batch), num, generators, bounds.action_dim)
            chosen.append(bounds.fit_step(action, step, num))
            return chosen[-1]

        self._step_through(repeat_rows(state, num), horizon, choose)
        rows = torch.stack(chosen, dim=1)
        return rearrange(rows, "(batch num) horizon action -> batch num horizon action", batch=batch)

    def _call_propose(
        self, state: State, num: int, horizon: int, generators: Sequence[torch.Generator], bounds: Bounds
    ) -> Tensor:
        batch = len(generators)
        rows = self.model.propose(state, num, horizon, generators)  # type: ignore[attr-defined]
        check_shape("propose()", rows, (batch * num, horizon, bounds.action_dim))
        rows = rows.to(bounds.low.dtype)
        return bounds.fit(rearrange(rows, "(batch num) horizon action -> batch num horizon action", batch=batch))

    def act(self, state: State, bounds: Bounds, step: int = 0) -> Tensor:
        """Returns the policy's mode at a step, within the bounds, (batch, action); NaN where the policy is NaN."""
        rows = count_rows(state)
        if not supports(self.model, "policy") and supports(self.model, "propose"):
            streams = [torch.Generator(bounds.low.device) for _ in range(rows)]  # the mode draws nothing from them
            action = self.model.propose(state, 1, 1, streams)[:, 0]  # type: ignore[attr-defined]
        else:
            require(self.model, "policy", "num_policy_samples above 0")
            action = self.model.policy(state, None)  # type: ignore[attr-defined]
        check_shape("policy()", action, (rows, bounds.action_dim))
        return bounds.fit_step(action, step)

    def continue_by_policy(self, state: State, actions: Tensor, is_tail: Tensor, bounds: Bounds) -> Tensor:
        """Returns the sequences (batch, horizon, action) with the policy's mode where is_tail (batch, horizon, 1)."""
        if not has_policy(self.model):
            require(self.model, "policy", 'tail="policy"')
        filled: list[Tensor] = []
        for step in range(actions.shape[1]):
            action = actions[:, step]
            if bool(is_tail[:, step].any()):
                mode = self.act(state, bounds, step)
                action = torch.where(is_tail[:, step] & torch.isfinite(mode), mode, action)
            filled.append(action)
            state, _ = take_step(self.model, state, action, self.generator)
        return torch.stack(filled, dim=1)

    @property
    def _needs_states(self) -> bool:
        return any(term.needs_states for term in (self.objective, *self.constraints))

    def _imagine(self, start: State, actions: Tensor, batch: int, particles: int, with_states: bool) -> Rollout:
        if with_states or self.use_continues or not supports(self.model, "rollout"):
            rewards, states, weights = self._step_through(start, actions.shape[1], lambda step, _: actions[:, step])
            last_state = states[-1]
        else:
            rewards, last_state = call_with(self.model.rollout, self.generator, start, actions)  # type: ignore[attr-defined]
            check_shape("rollout()'s rewards", rewards, actions.shape[:2])
            rewards, states, weights = rewards.to(self.discounts.dtype), (), self.discounts
        parts = (actions, rewards, weights, start, last_state, states, self.find_last_action, self.generator)
        return Rollout(self.model, batch, particles, *parts)

    def _step_through(
        self, state: State, horizon: int, choose: Callable[[int, State], Tensor]
    ) -> tuple[Tensor, tuple[State, ...], Tensor]:
        """Returns rewards (rows, horizon), the state after each step, and the weights of the steps."""
        states: list[State] = []
        rewards, continues = [], []
        for step in range(horizon):
            action = choose(step, state)
            state, reward = take_step(self.model, state, action, self.generator)
            _check_reward(reward, len(action))
            states.append(state)
            rewards.append(reward)
            if self.use_continues:
                continues.append(self.model.continues(state))  # type: ignore[attr-defined]
                check_shape("continues()", continues[-1], action.shape[:1])
        weights = self.discounts
        if self.use_continues:
            survival = torch.stack(continues, dim=1).to(weights.dtype).cumprod(dim=1)
            weights = weights * torch.nn.functional.pad(survival, (1, 0), value=1.0)
        return torch.stack(rewards, dim=1).to(self.discounts.dtype), tuple(states), weights

    def score_rollout(self, rollout: Rollout) -> Scores:
        """Returns the scores of the candidates of a rollout, (batch, sample)."""
        returns = _per_candidate(self.objective(rollout), rollout, "mean", "the objective")
        if not self.constraints:
            return Scores(returns)
        violations = torch.stack(
            [
                _per_candidate(constraint(rollout), rollout, "max", "a constraint").clamp_min(0.0)
                for constraint in self.constraints
            ]
        ).sum(dim=0)
        if self.penalty is None:
            return Scores(returns, violations)
        return Scores(returns - self.penalty * violations, violations, is_ranked=False)


def _check_reward(reward: Any, rows: int) -> None:
    check_tensor("step()'s reward", reward, (rows,))
    if reward.shape != (rows,):
        raise ValueError(
            f"step()'s reward must have shape ({rows},), got {tuple(reward.shape)}: one number per row; dim 0 of a "
            "state is its rows (state[None] for one environment, state.flatten(0, 1) for two such dimensions)"
        )


def _per_candidate(values: Tensor, rollout: Rollout, over_particles: str, name: str) -> Tensor:
    """Returns values (rows,) as (batch, sample), reduced over particles, in the precision of the rewards."""
    check_shape(name, values, rollout.actions.shape[:1])
    pattern = "(batch sample particle) -> batch sample"
    sizes = {"batch": rollout.batch, "particle": rollout.num_particles}
    if rollout.num_particles == 1:
        return values.to(rollout.rewards.dtype).unflatten(0, (rollout.batch, -1))
    return reduce(values.to(rollout.rewards.dtype), pattern, over_particles, **sizes)


def _policy_actions(
    model: Model, state: State, num: int, generators: Sequence[torch.Generator], action_dim: int
) -> Tensor:
    """Returns the policy's mode for the first row of each environment and samples for the others, (rows, action).

    Args:
        model: A model with a policy.
        state: States, (batch, num, ...).
        num: Number of rows per environment.
        generators: One stream per environment.
        action_dim: Size of an action.

    Raises:
        TypeError: The policy returns no tensor.
        ValueError: The policy returns actions of another shape.
    """
    mode = model.policy(tree_map(lambda leaf: leaf[:, 0], state), None)  # type: ignore[attr-defined]
    check_shape("policy()", mode, (len(generators), action_dim))
    if num == 1:
        return mode
    sampled = [
        model.policy(tree_map(lambda leaf, index=index: leaf[index, 1:], state), generator)  # type: ignore[attr-defined]
        for index, generator in enumerate(generators)
    ]
    for actions in sampled:
        check_shape("policy()", actions, (num - 1, action_dim))
    both = torch.cat([mode[:, None], torch.stack(sampled)], dim=1)
    return rearrange(both, "batch num action -> (batch num) action")
