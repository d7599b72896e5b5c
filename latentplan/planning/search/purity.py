"""Notices models that write into the tensors they are given, at the first search in a model."""

from __future__ import annotations

import contextlib
import weakref
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves, tree_map

from latentplan.planning.model import State


class FirstSearches:
    """Remembers the models that a planner has searched in, without keeping them alive. A copy remembers none."""

    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}

    def is_new(self, model: object) -> bool:
        """Returns whether a model is not remembered."""
        known = self._seen.get(id(model))
        return known is None or known() is not model

    def add(self, model: object) -> bool:
        """Remembers a model; returns whether the model was new."""
        if not self.is_new(model):
            return False
        key = id(model)
        with contextlib.suppress(TypeError):  # without weak references a model cannot be told from a later one
            self._seen[key] = weakref.ref(model, lambda _: self._seen.pop(key, None))
        return True

    def __reduce__(self) -> tuple[type[FirstSearches], tuple[()]]:
        return FirstSearches, ()


class Watch:
    """Copies of tensors that a model must not change.

    Args:
        start: States at the start of candidates.
        actions: The candidates.
    """

    def __init__(self, start: State, actions: Tensor) -> None:
        self._given = start, actions
        self._copies = tree_map(torch.clone, self._given)

    def check(self, model: object, last_state: State, num_rows: int) -> None:
        """Refuses a model that has changed the tensors, or that returned states of another number of rows.

        Args:
            model: The model.
            last_state: The states that it returned after the last action of the candidates.
            num_rows: Rows of the candidates, with those of particles.

        Raises:
            ValueError: A tensor differs from its copy, or a state has another number of rows than the actions.
        """
        for leaf in tree_leaves(last_state):
            if isinstance(leaf, Tensor) and leaf.shape[:1] != (num_rows,):
                raise ValueError(
                    f"{type(model).__name__} returned a state of shape {tuple(leaf.shape)} for {num_rows} rows of "
                    "actions; dim 0 of a state is its rows"
                )
        for name, given, copy in zip(("state", "action"), self._given, self._copies, strict=True):
            pairs = zip(tree_leaves(given), tree_leaves(copy), strict=True)
            if not all(bool(((left == right) | ((left != left) & (right != right))).all()) for left, right in pairs):
                raise ValueError(describe_writing(model, name))


def describe_writing(model: object, name: str) -> str:
    """Returns the message for a model that writes into its state or action."""
    return (
        f"{type(model).__name__} writes into the {name} it is given; step(), rollout() and what they call must return "
        f"new tensors ({name} + change instead of {name} += change, or {name}.clone() first)"
    )
