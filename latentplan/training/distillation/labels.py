"""Labels for distillation: the planner's first action at many beliefs, and a store of beliefs with their labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from latentplan.models import Gaussian, State, WorldModel
from latentplan.models.symmetry import TurnedModel
from latentplan.planning import Plan, Planner

COLUMNS = {"deter", "stoch", "mean", "std", "round"}


def plan_actions(
    planner: Planner,
    model: WorldModel | TurnedModel,
    states: State,
    generator: torch.Generator,
    rows_per_call: int,
    report: Callable[[int], None],
) -> Gaussian:
    """Labels beliefs: plans at every belief without a warm start, and returns the first actions.

    Args:
        planner: The search.
        model: The world model in which the planner searches.
        states: Beliefs, (rows, ...).
        generator: Source of the sampling noise.
        rows_per_call: Beliefs planned in one batch.
        report: Called after each batch with the number of beliefs planned so far.

    Returns:
        Mean and std, (rows, action) each.

    Raises:
        FloatingPointError: A search found no finite return.
    """
    parts = []
    for rows in zip(*(part.split(rows_per_call) for part in states), strict=True):
        with model.trunk_precision():
            plan = planner.plan(model, State(*rows), generator=generator)
        parts.append(read_first_actions(plan, planner.min_std))
        report(sum(len(mean) for mean, _ in parts))
    means, stds = zip(*parts, strict=True)
    return Gaussian(torch.cat(means), torch.cat(stds))


def read_first_actions(plan: Plan, min_std: float) -> Gaussian:
    """Mean and std of a plan's first actions, (batch, action) each; the std is at least `min_std`.

    Raises:
        FloatingPointError: The search found no finite return at some state.
    """
    mean, std = plan.action_distribution(min_std)
    num_failed = int(torch.isnan(mean).any(-1).sum())
    if num_failed:
        raise FloatingPointError(f"the planner found no finite return at {num_failed} of {len(mean)} states")
    return Gaussian(mean, std)


class Demonstrations:
    """A store of beliefs, each with the planner's first action as its label and the round in which it was labelled.

    The store holds float32 in main memory.
    """

    def __init__(self) -> None:
        self.columns: dict[str, Tensor] = {}

    def __len__(self) -> int:
        """Number of beliefs."""
        return len(self.columns["round"]) if self.columns else 0

    def add(self, states: State, actions: Gaussian, round_index: int) -> None:
        """Store beliefs (rows, ...) with the planner's first actions (rows, action)."""
        rounds = torch.full((len(states.deter),), round_index)
        floats = {**states._asdict(), **actions._asdict()}
        new = {**{name: value.float() for name, value in floats.items()}, "round": rounds}
        for name, value in new.items():
            held = [self.columns[name]] if name in self.columns else []
            self.columns[name] = torch.cat([*held, value.detach().cpu()])

    def oldest(self, count: int) -> Tensor:
        """Finds the rows of the `count` beliefs with the oldest labels, (count,)."""
        return self.columns["round"].argsort(stable=True)[:count]

    def states(self, rows: Tensor) -> State:
        """The beliefs at rows (count,)."""
        return State(self.columns["deter"][rows], self.columns["stoch"][rows])

    def actions(self, rows: Tensor) -> Gaussian:
        """The planner's first actions at rows (count,)."""
        return Gaussian(self.columns["mean"][rows], self.columns["std"][rows])

    def replace(self, rows: Tensor, actions: Gaussian, round_index: int) -> None:
        """Replace the labels at rows (count,), planned in round `round_index`."""
        self.columns["mean"][rows] = actions.mean.float().cpu()
        self.columns["std"][rows] = actions.std.float().cpu()
        self.columns["round"][rows] = round_index

    def state_dict(self) -> dict[str, Any]:
        """All columns by name."""
        return dict(self.columns)

    def load_state_dict(self, columns: dict[str, Any]) -> None:
        """Load columns that `state_dict` returned.

        Raises:
            ValueError: The columns have other names or different numbers of rows.
        """
        if columns and (set(columns) != COLUMNS or len({value.shape[:1] for value in columns.values()}) > 1):
            raise ValueError(f"labels must have the columns {', '.join(sorted(COLUMNS))}, of one length")
        self.columns = dict(columns)
