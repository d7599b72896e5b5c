"""The space that a search samples, and how a point of this space becomes a sequence of actions.

Without a spline a point is a sequence of actions. With `action_spline` a point is the knots of a spline over the plan.
With `overshoot` a point may leave the bounds, and its actions are then at the bounds. Either way the actions keep the
bounds and the rate limit, and discrete dimensions take one of their values, so models, constraints and controllers only
see actions that can be executed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from latentplan.planning.model import Bound, per_step
from latentplan.planning.search.choices import Choices
from latentplan.planning.search.products import contract


def read_bounds(
    low: Bound, high: Bound, action_dim: int, choices: Mapping[int, Sequence[float]]
) -> tuple[Tensor, Tensor]:
    """Returns the lowest and the highest action, each (1 or batch, 1 or horizon, action), float64.

    Args:
        low: Lowest action of continuous dimensions, see `CEMPlanner`.
        high: Highest action of continuous dimensions.
        action_dim: Numbers in an action.
        choices: By discrete dimension, its values, which replace the bounds there.

    Raises:
        ValueError: A bound has a wrong shape, or is not finite.
    """
    lowest = per_step(low, action_dim, "action_low").clone()
    highest = per_step(high, action_dim, "action_high").clone()
    for dim, values in choices.items():
        lowest[..., dim], highest[..., dim] = min(values), max(values)
    return lowest, highest


@dataclass(frozen=True)
class Bounds:
    """The lowest and the highest action of each environment and step, and the values of discrete dimensions.

    Attributes:
        low: Lowest action, (1 or batch, 1 or horizon, action).
        high: Highest action, shaped like `low`.
        choices: The discrete dimensions; None without any.
    """

    low: Tensor
    high: Tensor
    choices: Choices | None = None

    @property
    def action_dim(self) -> int:
        """Numbers in an action."""
        return self.low.shape[-1]

    def fit(self, sequences: Tensor, *, in_place: bool = False) -> Tensor:
        """Returns sequences (batch, horizon, action) or (batch, sample, horizon, action) of actions that are allowed.

        Args:
            sequences: The sequences.
            in_place: Whether the given tensor may be changed.
        """
        low, high = self.low, self.high
        if sequences.ndim == 4:
            low, high = low[:, None], high[:, None]
        if in_place:
            fitted = torch.minimum(torch.maximum(sequences, low, out=sequences), high, out=sequences)
        else:
            fitted = torch.clamp(sequences, low, high)
        return fitted if self.choices is None else self.choices.snap(fitted)

    def fit_step(self, actions: Tensor, step: int, num: int = 1) -> Tensor:
        """Returns actions (rows, action) of one step that are allowed, for `num` rows per environment, batch-major."""
        low, high = self.at(step)
        if num > 1:
            low, high = (bound.repeat_interleave(num, dim=0) if len(bound) > 1 else bound for bound in (low, high))
        fitted = torch.clamp(actions.to(low.dtype), low, high)
        return fitted if self.choices is None else self.choices.snap(fitted)

    def at(self, step: int) -> tuple[Tensor, Tensor]:
        """Returns the lowest and the highest action of one step, each (1 or batch, action)."""
        low, high = (bound[:, step if bound.shape[1] > 1 else 0] for bound in (self.low, self.high))
        return low, high

    def widened(self, overshoot: float) -> Bounds:
        """Returns bounds that lie further out by `overshoot` times the range; discrete dimensions keep theirs."""
        margin = overshoot * (self.high - self.low)
        if self.choices is not None:
            margin = margin.index_fill(-1, self.choices.dims, 0.0)
        return Bounds(self.low - margin, self.high + margin, self.choices)

    def select(self, steps: Tensor) -> Bounds:
        """Returns the bounds of the steps (chosen,) int."""
        low, high = (bound if bound.shape[1] == 1 else bound[:, steps] for bound in (self.low, self.high))
        return Bounds(low, high, self.choices)


class Space:
    """The space that a search samples.

    Args:
        bounds: Bounds of the actions.
        horizon: Number of actions of a plan.
        spline: `zero`, `linear` or `cubic`; None searches over the actions themselves.
        num_knots: Number of knots of a spline.
        overshoot: How far a point may leave the bounds, in ranges of the action.
        max_change: Largest change of an action from one step to the next, (action,); None without a rate limit.
        last_action: The action executed last, NaN where unknown, (batch, action); used with `max_change` only.

    Attributes:
        length: Number of steps of a point: of actions, or of knots.
        point_bounds: Bounds of a point.
        is_bounded: Whether the bounds of a point are those of the actions.
    """

    def __init__(
        self,
        bounds: Bounds,
        horizon: int,
        *,
        spline: str | None = None,
        num_knots: int = 0,
        overshoot: float = 0.0,
        max_change: Tensor | None = None,
        last_action: Tensor | None = None,
    ) -> None:
        self.bounds, self.horizon, self.choices = bounds, horizon, bounds.choices
        self.max_change, self.last_action = max_change, last_action
        self.length, self.is_bounded = horizon, overshoot == 0.0
        self.point_bounds = bounds if self.is_bounded else bounds.widened(overshoot)
        self._steps: Tensor | None = None
        self._matrix: Tensor | None = None
        if spline is None:
            return
        self.length = num_knots
        maps = _spline_maps(spline, horizon, num_knots, bounds.low.dtype, bounds.low.device)
        self._matrix, self._inverse, self._hold, self._steps = maps
        self.point_bounds = self.point_bounds.select(self._steps)

    @property
    def is_plain(self) -> bool:
        """Whether a point within the bounds is a sequence of actions that can be executed."""
        return self._matrix is None and self.choices is None and self.max_change is None and self.is_bounded

    def clean(self, points: Tensor, *, in_place: bool = False) -> Tensor:
        """Returns points within their bounds; points that are actions also keep the rate limit.

        Args:
            points: (batch, length, action) or (batch, sample, length, action).
            in_place: Whether the given tensor may be changed.
        """
        points = self.point_bounds.fit(points, in_place=in_place)
        return self._limit_changes(points) if self._matrix is None and self.is_bounded else points

    def decode(self, points: Tensor) -> Tensor:
        """Returns the actions (..., horizon, action) of clean points (..., length, action)."""
        if self._matrix is None:
            return points if self.is_bounded else self._limit_changes(self.bounds.fit(points))
        actions = contract("hk,...ka->...ha", self._matrix, points)
        if self.choices is not None:
            held = contract("hk,...ka->...ha", self._hold, points)
            actions = self.choices.join(actions, self.choices.snap(held))
        return self._limit_changes(self.bounds.fit(actions))

    def carry(self, points: Tensor) -> Tensor:
        """Returns the sequences (..., horizon, action) of clean points that a plan keeps for the next search.

        They are actions; without a spline, points outside of the bounds stay there.
        """
        return points if self._matrix is None else self.decode(points)

    def fit_carried(self, sequences: Tensor) -> Tensor:
        """Returns kept sequences as `carry` would return them in this space."""
        return (self.point_bounds if self._matrix is None else self.bounds).fit(sequences)

    def decode_var(self, var: Tensor) -> Tensor:
        """Returns the variance of the actions, (batch, horizon, action), from that of a point."""
        return var if self._matrix is None else contract("hk,...ka->...ha", self._matrix.square(), var)

    def encode(self, actions: Tensor) -> Tensor:
        """Returns the clean points (..., length, action) whose actions come closest to the given ones."""
        if self._matrix is None:
            return actions if self.is_plain else self.clean(actions)
        points = contract("kh,...ha->...ka", self._inverse, actions)
        if self.choices is not None:  # a mean of choices is no choice
            first_held = self._hold.argmax(dim=0)  # the first step of each knot's value
            points = self.choices.join(points, actions[..., first_held, :])
        return self.clean(points)

    def at_points(self, value: Tensor) -> Tensor:
        """Returns a value per step, (1 or batch, 1 or horizon, action), at the steps of a point."""
        return value if self._steps is None or value.shape[1] == 1 else value[:, self._steps]

    def excess_change(self, actions: Tensor) -> Tensor | None:
        """Returns the changes beyond the rate limit, summed over steps and dimensions; None without a rate limit.

        The sum is above 0 only where the bounds prevail over the limit.

        Args:
            actions: Decoded actions, (batch, horizon, action) or (batch, sample, horizon, action).

        Returns:
            The sum, (batch,) or (batch, sample).
        """
        if self.max_change is None:
            return None
        first = actions[..., :1, :]
        if self.last_action is not None:
            last = self.last_action[:, None] if actions.ndim == 3 else self.last_action[:, None, None]
            first = torch.where(torch.isnan(last), first, last)
        before = torch.cat([first, actions[..., :-1, :]], dim=-2)
        # The sums are those of `_limit_changes`, so that a limited action exceeds none of them by rounding.
        above, below = actions - (before + self.max_change), (before - self.max_change) - actions
        return (above.clamp_min(0.0) + below.clamp_min(0.0)).sum(dim=(-2, -1))

    def _limit_changes(self, actions: Tensor) -> Tensor:
        """Returns the actions with each change limited to `max_change`; the bounds prevail over the limit."""
        if self.max_change is None:
            return actions
        limited: list[Tensor] = []
        previous = self.last_action
        if previous is not None and actions.ndim == 4:
            previous = previous[:, None]
        for step, action in enumerate(actions.unbind(dim=-2)):
            if previous is not None:
                near = torch.clamp(action, previous - self.max_change, previous + self.max_change)
                near = torch.where(torch.isnan(previous), action, near)
                low, high = (bound[:, None] if actions.ndim == 4 else bound for bound in self.bounds.at(step))
                action = torch.clamp(near, low, high)
            limited.append(action)
            previous = action
        return torch.stack(limited, dim=-2)


@lru_cache(maxsize=32)
def _spline_maps(
    spline: str, horizon: int, num_knots: int, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns the matrices of a spline, made once because a pseudo-inverse at every decision takes long.

    Returns:
        The weight of each knot in each action (horizon, knot), its pseudo-inverse (knot, horizon), the weights of a
        spline that holds each knot (horizon, knot), and the steps of the knots (knot,) int.
    """
    matrix = _spline_matrix(spline, horizon, num_knots)
    maps = (matrix, torch.linalg.pinv(matrix), _spline_matrix("zero", horizon, num_knots))
    steps = torch.linspace(0, horizon - 1, num_knots, device="cpu").round().long()
    forward, inverse, hold = (each.to(device, dtype) for each in maps)
    return forward, inverse, hold, steps.to(device)


def _spline_matrix(spline: str, horizon: int, num_knots: int) -> Tensor:
    """Returns the weight of each knot in each action, (horizon, knot) float64.

    `zero` holds each knot for an equal share of the horizon. `linear` and `cubic` have knots at equal distances from
    the first action to the last; the slopes of the cubic spline at its knots are those of Catmull and Rom.
    """
    if spline == "zero" or num_knots == 1:
        knot = torch.arange(horizon, device="cpu") * num_knots // horizon
        return torch.nn.functional.one_hot(knot, num_knots).double()
    time = torch.linspace(0, num_knots - 1, horizon, dtype=torch.float64, device="cpu")
    left = time.floor().clamp(max=num_knots - 2).long()
    part = (time - left)[:, None]
    eye = torch.eye(num_knots, dtype=torch.float64, device="cpu")
    before, after = eye[left], eye[left + 1]
    if spline == "linear":
        return (1 - part) * before + part * after
    slopes = torch.gradient(eye, dim=0)[0]
    basis = (2 * part**3 - 3 * part**2 + 1, part**3 - 2 * part**2 + part, 3 * part**2 - 2 * part**3, part**3 - part**2)
    parts = zip(basis, (before, slopes[left], after, slopes[left + 1]), strict=True)
    return torch.stack([weight * value for weight, value in parts]).sum(dim=0)
