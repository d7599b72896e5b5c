"""Boxes: goals that ask quantities to lie within intervals, which an agent can learn to pursue before it is asked.

Most expressions are one: `speed -> -1.0 and height > 1.1` asks `speed` into [-1, -1] and `height` into [1.1, inf).
What such a goal is worth is predicted from the latent, its value and its actor are those that were learned for boxes
drawn at random (universal value functions, Schaul et al. 2015).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from latentplan.objectives.expression import Absolute, Both, Clause, Expression, Name, Node, Number
from latentplan.planning.model import repeat_rows, take_step

Interval = tuple[float, float]


def paid_degree(shortfalls: Tensor) -> Tensor:
    """How far a clause is met, in [0, 1], as the simulator scores it: 1 where it is, 0.1 where one margin is missing.

    Args:
        shortfalls: In margins, any shape; 0 and below is met.
    """
    return torch.exp(math.log(0.1) * shortfalls.clamp_min(0.0).square())


def plan_degree(shortfalls: Tensor) -> Tensor:
    """How far a clause is met, in (0, 1], with a slope wherever it is not.

    The mean of the Gaussian that scores and of 1 / (1 + x), which falls slowly.

    Args:
        shortfalls: In margins, any shape; 0 and below is met.
    """
    return 0.5 * (paid_degree(shortfalls) + 1.0 / (1.0 + shortfalls.clamp_min(0.0)))


def box_degree(low: Tensor, high: Tensor, values: Tensor, scales: Tensor) -> Tensor:
    """How far quantities lie in a box, in (0, 1]: the product of the degrees of its intervals.

    Args:
        low: Lower ends, -inf where open, (..., quantity), as all of these broadcast.
        high: Upper ends, inf where open.
        values: Of the quantities.
        scales: What counts as one margin, (quantity,).

    Returns:
        Degrees, (...).
    """
    return plan_degree(torch.maximum(low - values, values - high) / scales).prod(-1)


def box_of(expression: Expression, quantities: Sequence[str]) -> dict[str, Interval] | None:
    """The box that an expression asks for, its intervals by quantity; None where it asks for something else.

    Args:
        expression: Clauses between one of the quantities, or its absolute value, and a number, joined by `and`. A
            weight makes no difference to who pursues nothing else.
        quantities: Those that a box can hold.
    """
    if len(expression.terms) != 1 or expression.terms[0][0] <= 0.0:
        return None
    box: dict[str, Interval] = {}
    for clause in _clauses(expression.terms[0][1]):
        found = None if clause is None else _interval(clause, quantities)
        if found is None:
            return None
        name, (low, high) = found
        least, most = box.get(name, (-math.inf, math.inf))
        low, high = max(low, least), min(high, most)
        if low > high:
            return None  # no value of the quantity is in both
        box[name] = low, high
    return box


@dataclass(frozen=True)
class BoxView:
    """Shows a world model with heads for goals as one that is paid for lying in a box; see `conditioned`.

    Attributes:
        intervals: By quantity.
        frames_per_step: Env frames that one imagined step stands for.
    """

    intervals: Mapping[str, Interval]
    frames_per_step: int

    def __call__(self, model: Any) -> BoxModel:
        """The model as seen by one who pursues the box."""
        open_ends = (-math.inf, math.inf)
        ends = [self.intervals.get(name, open_ends) for name in model.goal_names]
        low, high = torch.tensor(ends, device=model.device).unbind(-1)
        return BoxModel(model, low, high, self.frames_per_step)


class BoxModel:
    """A world model whose reward is the worth of a box, with the value and the actor that were learned for boxes.

    Args:
        model: With `goal_heads`, `goal_names` and `probe`.
        low: Lower ends of the intervals, (quantity,).
        high: Upper ends.
        frames_per_step: Env frames that one step stands for.
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
        """The next state, and what it is worth in the box, (rows,)."""
        following, _ = self.model.step(state, action)
        return following, self._worth(following.features)

    def fast_step(self, state: Any, action: Tensor) -> tuple[Any, Tensor]:
        """`step`, compiled where that can be, without gradients."""
        following, _ = self.model.fast_step(state, action)
        return following, self._worth(following.features)

    def rollout(self, state: Any, actions: Tensor) -> tuple[Tensor, Any]:
        """Worth (rows, time) along actions (rows, time, action), and the last state; quantities are read at once."""
        features = []
        for action in actions.unbind(1):
            state, _ = take_step(self.model, state, action)
            features.append(state.features)
        return self._worth(torch.stack(features, 1)), state

    def value(self, state: Any) -> Tensor:
        """Expected discounted worth from a state on, under the actor for the box, (rows,)."""
        with self.model.trunk_precision():
            value: Tensor = self.model.goal_heads.value(state.features, self._code)
        return value

    def policy(self, state: Any, generator: torch.Generator | None = None) -> Tensor:
        """The action for the box (rows, action): a sample when a generator is given, else the mode."""
        with self.model.trunk_precision():
            mean, std = self.model.goal_action(state.features, self._code)
        if generator is None:
            return mean  # type: ignore[no-any-return]
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return (mean + std * noise).clamp(-1.0, 1.0)  # type: ignore[no-any-return]

    def propose(self, state: Any, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """What the actor for the box does from each state, its mode first, (batch num, horizon, action)."""
        size = (num, horizon, self.model.action_dim)
        noise = torch.stack([torch.randn(size, generator=each, device=self.model.device) for each in generators])
        noise[:, 0] = 0.0
        rows, chosen = repeat_rows(state, num), []
        for draw in noise.flatten(0, 1).unbind(1):
            with torch.autocast(draw.device.type, enabled=False):  # for few rows converting costs more than it saves
                mean, std = self.model.goal_action(rows.features.float(), self._code)
            chosen.append((mean + std * draw).clamp(-1.0, 1.0))
            rows, _ = self.model.fast_step(rows, chosen[-1])
        return torch.stack(chosen, 1)

    def continues(self, state: Any) -> Tensor:
        """See `WorldModel.continues`."""
        going_on: Tensor = self.model.continues(state)
        return going_on

    def _worth(self, features: Tensor) -> Tensor:
        values = self.model.goal_quantities(features)
        return self._frames_per_step * box_degree(self._low, self._high, values, self.model.goal_scales)


def _clauses(node: Node) -> list[Clause | None]:
    """The clauses that a node joins by `and`, None for what is no clause."""
    if isinstance(node, Both):
        return _clauses(node.left) + _clauses(node.right)
    return [node if isinstance(node, Clause) else None]


def _interval(clause: Clause, quantities: Sequence[str]) -> tuple[str, Interval] | None:
    """The quantity that a clause is about and where it wants it; None where that is no interval of one quantity."""
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
