"""The plan that a search returns. A planner keeps no plan: the caller passes the previous plan to the next search."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from einops import rearrange
from torch import Tensor
from torch.utils._pytree import tree_map

from latentplan.planning.model import check_shape

# Attributes of a `Plan` that are tensors with the environment as dim 0; the last three are always on the CPU.
ON_CPU = ("is_warm", "elapsed", "is_followed")
TENSORS = ("actions", "mean", "var", "expected_return", "elites", *ON_CPU)


@dataclass(frozen=True, eq=False)
class Iteration:
    """One iteration of a search: what a callback receives, and what a plan keeps of its candidates.

    Attributes:
        index: Number of the iteration, from 0.
        actions: Candidates, (batch, sample, horizon, action).
        returns: Their predicted returns, (batch, sample).
        is_feasible: Whether a candidate satisfies all constraints and has a finite return, (batch, sample) bool.
        violations: Constraint violations, (batch, sample); None without constraints.
        states: Imagined states after each step, leaves (batch, sample, horizon, ...), where they were asked for; a
            model with particles has (batch, sample, particle, horizon, ...).
        mean: Mean of the distribution after the refit, (batch, horizon, action).
        std: Standard deviation of the distribution after the refit, (batch, horizon, action).
        elite_return: Mean return of the elites, (batch,).
        elites: The elites, best first, (batch, elite, horizon, action): the best of these candidates, and of those of
            earlier iterations that stay candidates. NaN where fewer candidates have a finite return.
    """

    index: int
    actions: Tensor
    returns: Tensor
    is_feasible: Tensor
    violations: Tensor | None
    states: Any
    mean: Tensor
    std: Tensor
    elite_return: Tensor
    elites: Tensor

    def take(self, rows: Tensor) -> Iteration:
        """Returns the iteration of the environments at rows (chosen,) int."""
        return self._map(lambda tensor: tensor[rows.to(tensor.device)])

    def copied(self) -> Iteration:
        """Returns this iteration with tensors of its own."""
        return self._map(torch.clone)

    def _map(self, change: Callable[[Tensor], Tensor]) -> Iteration:
        def apply(value: Any) -> Any:
            return change(value) if isinstance(value, Tensor) else value

        return Iteration(**{field.name: tree_map(apply, getattr(self, field.name)) for field in fields(self)})


@dataclass(frozen=True, eq=False)
class Plan:
    """The result of a search, for every environment in the call.

    The diagnostics in `info` are:

    - `elite_return`: mean return of the elites after each refit, (batch, iteration);
    - `std`: mean standard deviation of the samples after each refit, (batch, iteration);
    - `iterations`: number of refits, (batch,);
    - `num_nonfinite`: number of candidates whose return or violation was not finite, (batch,);
    - `is_fallback`: whether no candidate had a finite return and violation, or no iteration fitted the deadline, so
      that the actions are the tail of the previous plan, the start of a cold search, or the policy's, (batch,);
    - `is_policy`: whether no iteration fitted the deadline and the actions are the policy's, (batch,); false unless the
      policy makes proposals, and false with constraints or an objective for which the policy was not trained;
    - `violation`: violation of the chosen sequence, only with constraints, (batch,); a rate limit counts by the part
      of each change beyond the limit, which is 0 except where the bounds prevail; NaN where other constraints were not
      scored because no iteration fitted the deadline;
    - `stopped`: the reason the search ended, "iterations" or "deadline";
    - `gradient_pause`: number of searches that the last pause of gradient steps takes, (batch,), only with gradient
      steps;
    - `gradient_wait`: number of its searches that are left, (batch,), only with gradient steps;
    - `probabilities`: probability of each value, (batch, length, discrete, value), only with discrete actions; the
      length is the horizon, with a spline the number of knots.

    A planner of another kind must give `is_fallback`, `is_policy` and `num_nonfinite`.

    Attributes:
        actions: The chosen sequence within the bounds, (batch, horizon, action).
        mean: Mean of the search distribution, (batch, horizon, action).
        var: Variance of the search distribution, (batch, horizon, action).
        expected_return: Predicted return of the chosen sequence, (batch,). With the option `final` `mean` it is the
            mean return of the last elites, which may be higher than the return of their mean, unless the search scores
            the mean: for constraints other than rate limits, to compare it with the policy's sequence
            (`policy_margin`), or by gradient steps. Gradient steps score nothing while they pause, or where they do not
            fit the deadline. NaN where no candidate had a finite return and violation.
        info: Diagnostics by name, see above.
        elites: Kept elites, (batch, kept, horizon, action), if the planner keeps some; with the option `overshoot` they
            may lie outside of the bounds.
        is_warm: Whether the next search may start from this plan, (batch,) bool on the CPU.
        elapsed: Number of actions executed since this plan was made, (batch,) on the CPU; the next search shifts the
            plan by this number.
        is_followed: Whether the action executed last was this plan's, (batch,) bool on the CPU; None is everywhere.
        candidates: Every iteration of the search, if `plan` was called with `keep`; empty otherwise.
    """

    actions: Tensor
    mean: Tensor
    var: Tensor
    expected_return: Tensor
    info: dict[str, Any]
    elites: Tensor | None
    is_warm: Tensor
    elapsed: Tensor
    is_followed: Tensor | None = None
    candidates: tuple[Iteration, ...] = ()

    def __post_init__(self) -> None:
        """Marks the plan as followed where nothing else is known."""
        if self.is_followed is None:
            object.__setattr__(self, "is_followed", torch.ones_like(self.is_warm))

    @classmethod
    def around(cls, actions: Any) -> Plan:
        """Returns a plan from which a search starts warm: the distribution is centred on these actions.

        Args:
            actions: A trajectory, (horizon, action), or one for each environment, (batch, horizon, action): a tensor,
                an array or a sequence. The first action is the one that is due now.

        Raises:
            ValueError: The actions have another shape, there is no action, or an action is not finite.
        """
        sequence = actions if isinstance(actions, Tensor) else torch.as_tensor(actions, device="cpu")
        sequence = sequence if sequence.is_floating_point() else sequence.float()
        sequence = sequence[None] if sequence.ndim == 2 else sequence
        if sequence.ndim != 3 or sequence.numel() == 0:
            raise ValueError(
                "a trajectory has shape (horizon, action) or (batch, horizon, action), with one action or more, got "
                f"{tuple(sequence.shape)}"
            )
        if not bool(torch.isfinite(sequence).all()):
            raise ValueError("the actions of a trajectory must be finite")
        batch = len(sequence)
        unknown = sequence.new_full((batch,), torch.nan)
        zeros = torch.zeros(batch, dtype=torch.long, device="cpu")
        none = zeros.bool()
        info = {"is_fallback": none, "is_policy": none, "num_nonfinite": zeros}
        var = torch.zeros_like(sequence)
        return cls(sequence, sequence, var, unknown, info, None, ~none, zeros)

    @property
    def action(self) -> Tensor:
        """The first action of the chosen sequence, (batch, action)."""
        return self.actions[:, 0]

    @property
    def last_action(self) -> Tensor:
        """The action executed last, (batch, action); NaN where the plan has none or another agent acted."""
        index = (self.elapsed.clamp(1, self.actions.shape[1]) - 1).to(self.actions.device)
        action = torch.take_along_dim(self.actions, index[:, None, None], dim=1)[:, 0]
        assert self.is_followed is not None
        is_known = self.is_followed & (self.elapsed > 0) & (self.elapsed <= self.actions.shape[1])
        return action.masked_fill(~is_known.to(action.device)[:, None], torch.nan)

    def action_distribution(self, min_std: float) -> tuple[Tensor, Tensor]:
        """Returns mean and std of the search distribution over the first action, (batch, action) each.

        Args:
            min_std: Floor of the returned std.

        Returns:
            Mean and std; NaN where `is_fallback` is true.
        """
        failed = self.info["is_fallback"][:, None]
        std = self.var[:, 0].sqrt().clamp_min(min_std)
        return self.mean[:, 0].masked_fill(failed, torch.nan), std.masked_fill(failed, torch.nan)

    @property
    def source(self) -> str:
        """Where the first environment's actions come from: "plan", "tail" (of the previous plan) or "actor"."""
        if not bool(self.info["is_fallback"][0]):
            return "plan"
        return "actor" if bool(self.info["is_policy"][0]) else "tail"

    def failures(self) -> Tensor:
        """Returns where the actions come neither from a search nor from a policy, (batch,) bool on the CPU.

        These actions are the tail of the previous plan, or the start of a cold search; a caller with a policy should
        execute the policy.
        """
        return (self.info["is_fallback"] & ~self.info["is_policy"]).cpu()

    def warn_of_failures(self) -> None:
        """Warns if no candidate of an environment had a finite return and violation; a caller's policy acts there."""
        failed = self.info["is_fallback"] & ~self.info["is_policy"] & (self.info["num_nonfinite"] > 0)
        if bool(failed.any()):
            warnings.warn(
                "a search found nothing finite; the last plan or the policy acts", RuntimeWarning, stacklevel=2
            )

    def forget(self, mask: Tensor) -> Plan:
        """Returns this plan, except that the environments in mask (batch,) bool start cold, with no action before.

        Raises:
            TypeError: The mask is not a tensor.
            ValueError: The mask does not have one value for each environment.
        """
        check_shape("mask", mask, self.is_warm.shape)
        assert self.is_followed is not None
        is_left = ~mask.to("cpu", torch.bool)
        return replace(self, is_warm=self.is_warm & is_left, is_followed=self.is_followed & is_left)

    def executed(self, elapsed: Tensor) -> Plan:
        """Returns this plan with `elapsed` (batch,) as the number of executed actions."""
        return replace(self, elapsed=elapsed, is_followed=None)

    def aged(self) -> Plan:
        """Returns this plan one step later, after another agent acted; environments without actions left are cold."""
        elapsed = self.elapsed + 1
        nowhere = torch.zeros_like(self.is_warm)
        return replace(self, elapsed=elapsed, is_followed=nowhere).forget(elapsed >= self.mean.shape[1])

    def take(self, rows: Tensor) -> Plan:
        """Returns the plans of the environments at rows (chosen,) int, which may repeat."""

        def select(value: Any) -> Any:
            return value[rows.to(value.device)] if isinstance(value, Tensor) else value

        info = {name: select(value) for name, value in self.info.items()}
        candidates = tuple(iteration.take(rows) for iteration in self.candidates)
        return Plan(info=info, candidates=candidates, **{name: select(getattr(self, name)) for name in TENSORS})

    def spread(self, mask: Tensor) -> Plan:
        """Returns these plans, in order, at the environments in mask (batch,) bool, and cold copies elsewhere."""
        return self.take((mask.cumsum(0) - 1).clamp_min(0)).forget(~mask)

    def to_dict(self) -> dict[str, Any]:
        """A copy as tensors on the CPU, None and plain values, for `from_dict`."""

        def copy(value: Any) -> Any:
            return value.detach().cpu().clone() if isinstance(value, Tensor) else value

        info = {name: copy(value) for name, value in self.info.items()}
        return {name: copy(getattr(self, name)) for name in TENSORS} | {"info": info}

    @classmethod
    def from_dict(cls, values: dict[str, Any], device: torch.device) -> Plan:
        """The plan that `to_dict` copied; all but `is_warm`, `elapsed` and `is_followed` moves to a device."""

        def move(value: Any) -> Any:
            return value.to(device) if isinstance(value, Tensor) else value

        on_cpu = {name: values[name] for name in ON_CPU}
        moved = {name: move(values[name]) for name in TENSORS if name not in ON_CPU}
        return cls(info={name: move(value) for name, value in values["info"].items()}, **moved, **on_cpu)

    def updated(self, mask: Tensor, new: Plan) -> Plan:
        """Returns this plan, with the environments in mask (batch,) bool taken from a newer plan.

        The candidates are those of the newer plan, in every environment.
        """

        def select(older: Any, newer: Any) -> Any:
            if not isinstance(older, Tensor) or not isinstance(newer, Tensor) or older.shape != newer.shape:
                return newer  # diagnostics of another length exist for the newer search only
            is_newer = rearrange(mask.to(older.device), f"batch -> batch {' '.join(['1'] * (older.ndim - 1))}")
            return torch.where(is_newer, newer, older)

        info = {name: select(self.info.get(name), value) for name, value in new.info.items()}
        tensors = {name: select(getattr(self, name), getattr(new, name)) for name in TENSORS}
        return Plan(info=info, candidates=new.candidates, **tensors)


@dataclass(frozen=True)
class WarmStart:
    """The previous plan, shifted to the present.

    Attributes:
        mean: Shifted plan with its tail filled, and the start of a cold search where cold, within the bounds, (batch,
            horizon, action).
        elites: Shifted elites, (batch, kept, horizon, action), if any were kept.
        is_warm: Environments in which the previous plan is valid, (batch,) bool on the CPU.
    """

    mean: Tensor
    elites: Tensor | None
    is_warm: Tensor


def shift_plan(
    previous: Plan,
    *,
    rest: Tensor,
    tail: str,
    fit: Callable[[Tensor], Tensor],
    policy_tail: Callable[[Tensor, Tensor], Tensor],
) -> WarmStart:
    """Shifts a plan by the actions executed since it was made, and fills its tail.

    Args:
        previous: The previous plan, of any length, on any device.
        rest: The start of a cold search, (batch, horizon, action), in the precision of the next plan.
        tail: How the tail is filled: `zero` (with `rest`), `hold` (the last action repeated) or `policy`.
        fit: `fit(sequence) -> sequence` makes actions allowed, for (batch, horizon, action) and (batch, kept, ...).
        policy_tail: `policy_tail(sequence, is_tail) -> sequence` fills the tail with the model's policy.
    """
    length, horizon = previous.mean.shape[1], rest.shape[1]
    device = rest.device
    position = torch.arange(horizon, device="cpu")[None] + previous.elapsed[:, None]
    is_tail = (position >= length).to(device)[..., None]  # (batch, horizon, 1)
    index = position.clamp_max(length - 1).to(device)[..., None]

    def move(sequence: Tensor) -> Tensor:
        """Returns the shifted sequence in this search's precision, its last action repeated past its end (`hold`)."""
        return torch.take_along_dim(sequence.to(rest), index, dim=1)

    is_warm = previous.is_warm.to(device)[:, None, None]
    mean = move(previous.actions)
    if tail == "zero":
        mean = torch.where(is_tail, rest, mean)
    elif tail == "policy":
        mean = policy_tail(mean, is_tail)
    mean = fit(torch.where(is_warm, mean, rest))

    elites = previous.elites
    if elites is not None:
        elites = torch.take_along_dim(elites.to(rest), index[:, None], dim=2)
        elites = fit(torch.where(is_tail[:, None], mean[:, None], elites))
    return WarmStart(mean, elites, previous.is_warm)
