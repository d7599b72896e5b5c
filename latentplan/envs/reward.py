"""Reward given by an expression over named quantities, in place of the task's reward."""

from __future__ import annotations

import numpy as np

from latentplan.config.quantities import scales
from latentplan.envs.true_quantities import clause_degree
from latentplan.objectives.expression import evaluate
from latentplan.objectives.parser import parse_reward


class ObjectiveReward:
    """The reward of one control step: the value of an expression over the quantities of a body.

    Args:
        text: An expression in the language of test-time objectives, without `return`, goal images and later phases.
        domain: Domain whose quantities the expression names.

    Raises:
        UserError: The text is no such expression.
    """

    def __init__(self, text: str, domain: str) -> None:
        self._expression = parse_reward(text, scales(domain), "env.objective")
        self._names = tuple(scales(domain))

    def __call__(self, values: np.ndarray) -> float:
        """The reward for the true values of the domain's quantities, (quantity,)."""
        lookup = dict(zip(self._names, values, strict=True)).__getitem__
        return float(sum(weight * evaluate(term, lookup, clause_degree) for weight, term in self._expression.terms))
