"""Rewards that the user writes down, in place of a task's own."""

from __future__ import annotations

import numpy as np

from latentplan.envs.true_quantities import clause_degree, scales
from latentplan.objectives.expression import evaluate
from latentplan.objectives.parser import parse_reward


class ObjectiveReward:
    """What an expression over a body's quantities pays in one control step.

    Args:
        text: In the language of test-time objectives, without `return`, goal images and changes of mind.
        domain: Domain of `dm_control.suite`, whose quantities it names.

    Raises:
        UserError: The text is no such expression.
    """

    def __init__(self, text: str, domain: str) -> None:
        self._expression = parse_reward(text, scales(domain), "env.objective")
        self._names = tuple(scales(domain))

    def __call__(self, values: np.ndarray) -> float:
        """The reward where the quantities have these true values, (quantity,)."""
        lookup = dict(zip(self._names, values, strict=True)).__getitem__
        return float(sum(weight * evaluate(term, lookup, clause_degree) for weight, term in self._expression.terms))
