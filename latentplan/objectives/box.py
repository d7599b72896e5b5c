"""Boxes: goals that ask quantities to lie within intervals, and a view of the world model for one box.

Most objectives are boxes: `speed -> -1.0 and height > 1.1` asks for `speed` in [-1, -1] and `height` in [1.1, inf). A
goal-conditioned agent learns a value and an actor for boxes drawn at random (universal value functions, Schaul et al.
2015), so it can pursue any box without more training. The reward of a box is computed from predicted quantities.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from latentplan.objectives.expression import Absolute, And, Clause, Expression, Name, Node, Number
from latentplan.planning.model import repeat_rows, take_step

Interval = tuple[float, float]


def scoring_degree(shortfalls: Tensor) -> Tensor:
    """Degree to which a clause is met, in [0, 1], as in scores: 1 if met, 0.1 at a shortfall of 1 margin.

    Args:
        shortfalls: Shortfalls in margins, any shape; a clause is met at 0 and below.
    """
    return torch.exp(math.log(0.1) * shortfalls.clamp_min(0.0).square())


def planning_degree(shortfalls: Tensor) -> Tensor:
    """Degree to which a clause is met, in (0, 1], with a gradient wherever the clause is not met.

    The degree is the mean of `scoring_degree` and of 1 / (1 + shortfall), which falls slowly, so that a search far from
    the goal still makes progress.

    Args:
        shortfalls: Shortfalls in margins, any shape; a clause is met at 0 and below.
    """
    return 0.5 * (scoring_degree(shortfalls) + 1.0 / (1.0 + shortfalls.clamp_min(0.0)))


def box_degree(low: Tensor, high: Tensor, values: Tensor, scales: Tensor) -> Tensor:
    """Degree to which quantities lie in a box, in (0, 1]: the product of the degrees of its intervals.

    Args:
        low: Lower ends of the intervals, -inf where open, (..., quantity); broadcasts with `high` and `values`.
        high: Upper ends of the intervals, inf where open, (..., quantity).
        values: Values of the quantities, (..., quantity).
        scales: Margin of each quantity, (quantity,).

    Returns:
        Degrees, (...).
    """
    return planning_degree(torch.maximum(low - values, values - high) / scales).prod(-1)


def box_of(expression: Expression, quantities: Sequence[str]) -> dict[str, Interval] | None:
    """The box of an expression, as intervals by quantity; None if the expression is not a box.

    An expression is a box if it has one term, and the term consists of clauses joined by `and`, each between a quantity
    (or its absolute value) and a number. A positive weight of the term does not change the best plan and is ignored.

    Args:
        expression: The objective.
        quantities: Names of the quantities that a box can hold.
    """
    if len(expression.terms) != 1 or expression.terms[0][0] <= 0.0:
        return None
    box: dict[str, Interval] = {}
    for clause in _clauses(expression.terms[0][1]):
        found = None if clause is None else _interval(clause, quantities)
        if found is None:
            return None
        name, (low, high) = found
        earlier_low, earlier_high = box.get(name, (-math.inf, math.inf))
        low, high = max(low, earlier_low), min(high, earlier_high)
        if low > high:
            return None  # the two intervals of this quantity do not overlap
        box[name] = low, high
    return box


@dataclass(frozen=True)
class BoxView:
    """Turns a world model with goal heads into a model whose reward is the degree of a box; for `conditioned`.

    Attributes:
        intervals: Lower and upper end by quantity; quantities without an interval are open.
        frames_per_step: Env frames per model step.
    """

    intervals: Mapping[str, Interval]
    frames_per_step: int

    def __call__(self, model: Any) -> BoxModel:
        """The model with reward, value and policy of the box."""
        open_ends = (-math.inf, math.inf)
        ends = [self.intervals.get(name, open_ends) for name in model.goal_names]
        low, high = torch.tensor(ends, device=model.device, dtype=torch.float32).unbind(-1)
        return BoxModel(model, low, high, self.frames_per_step)


class BoxModel:
    """A world model whose reward is the degree of a box, with the value and the actor that were learned for boxes.

    Args:
        model: World model with `goal_heads`, `goal_names` and `probe`.
        low: Lower ends of the intervals, (quantity,).
        high: Upper ends of the intervals, (quantity,).
        frames_per_step: Env frames per model step.
    """

    def __init__(self, model: Any, low: Tensor, high: Tensor, frames_per_step: int) -> None:
        self.model, self.label_names = model, model.label_names
        self._low, self._high, self._frames_per_step = low, high, frames_per_step
        self._code = model.goal_heads.encode(low, high)

    def probe(self, features: Tensor) -> Tensor:
        """See `WorldModel.probe`."""
        predicted: Tensor = self.model.probe(features)
        return predicted

    def step(self, state: Any, action: Tensor) -> tuple[Any, Tensor]:
        """The next state, and the reward of the box in that state, (rows,)."""
        next_state, _ = self.model.step(state, action)
        return next_state, self._reward(next_state.features)

    def fast_step(self, state: Any, action: Tensor) -> tuple[Any, Tensor]:
        """`step` without gradients, on the fast path of the model where it has one."""
        next_state, _ = self.model.fast_step(state, action)
        return next_state, self._reward(next_state.features)

    def rollout(self, state: Any, actions: Tensor) -> tuple[Tensor, Any]:
        """Rewards (rows, time) along actions (rows, time, action), and the last state."""
        features = []
        for action in actions.unbind(1):
            state, _ = take_step(self.model, state, action)
            features.append(state.features)
        return self._reward(torch.stack(features, 1)), state  # one call for all steps is faster

    def value(self, state: Any) -> Tensor:
        """Expected discounted reward of the box from a state on under the actor for the box, (rows,)."""
        with self.model.trunk_precision():
            value: Tensor = self.model.goal_heads.value(state.features, self._code)
        return value

    def policy(self, state: Any, generator: torch.Generator | None = None) -> Tensor:
        """Actions of the actor for the box, (rows, action): samples if a generator is given, else the mode."""
        with self.model.trunk_precision():
            mean, std = self.model.goal_action(state.features, self._code)
        if generator is None:
            return mean  # type: ignore[no-any-return]
        noise = torch.randn(mean.shape, generator=generator, device=mean.device, dtype=torch.float32)
        return (mean + std * noise).clamp(-1.0, 1.0)  # type: ignore[no-any-return]

    def propose(self, state: Any, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """Action sequences of the actor for the box from each state, the mode first, (batch num, horizon, action)."""
        size = (num, horizon, self.model.action_dim)
        settings: Any = {"device": self.model.device, "dtype": torch.float32}
        noise = torch.stack([torch.randn(size, generator=each, **settings) for each in generators])
        noise[:, 0] = 0.0
        rows, actions = repeat_rows(state, num), []
        for draw in noise.flatten(0, 1).unbind(1):
            # In float32, because casting costs more time than bfloat16 saves for few rows.
            with torch.autocast(draw.device.type, enabled=False):
                mean, std = self.model.goal_action(rows.features.float(), self._code)
            actions.append((mean + std * draw).clamp(-1.0, 1.0))
            rows, _ = self.model.fast_step(rows, actions[-1])
        return torch.stack(actions, 1)

    def continues(self, state: Any) -> Tensor:
        """See `WorldModel.continues`."""
        continues: Tensor = self.model.continues(state)
        return continues

    def _reward(self, features: Tensor) -> Tensor:
        values = self.model.goal_quantities(features)
        return self._frames_per_step * box_degree(self._low, self._high, values, self.model.goal_scales)


def _clauses(node: Node) -> list[Clause | None]:
    """The clauses that a node joins by `and`, with None for every part that is not a clause."""
    if isinstance(node, And):
        return _clauses(node.left) + _clauses(node.right)
    return [node if isinstance(node, Clause) else None]


def _interval(clause: Clause, quantities: Sequence[str]) -> tuple[str, Interval] | None:
    """The quantity and the interval of a clause; None if the clause is not an interval of one quantity."""
    left, right, relation = clause.left, clause.right, clause.relation
    if isinstance(left, Number):
        left, right, relation = right, left, {"<": ">", ">": "<"}.get(relation, relation)
    inner = left.inner if isinstance(left, Absolute) else left
    if not isinstance(right, Number) or not isinstance(inner, Name) or inner.name not in quantities:
        return None
    bound = right.value
    if isinstance(left, Absolute):
        is_interval = (relation == "<" and bound >= 0.0) or (relation == "->" and bound == 0.0)
        return (inner.name, (-bound, bound)) if is_interval else None
    return inner.name, {"<": (-math.inf, bound), ">": (bound, math.inf), "->": (bound, bound)}[relation]
