"""The plan that a search returns. A planner keeps no plan: the caller passes the previous plan to the next search."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from einops import rearrange
from torch import Tensor

TENSORS = ("actions", "mean", "var", "expected_return", "elites", "is_warm", "elapsed")  # attributes of a `Plan`


@dataclass(frozen=True)
class Plan:
    """The result of a search, for every environment in the call.

    The diagnostics in `info` are:

    - `elite_return`: mean return of the elites after each refit, (batch, iteration);
    - `std`: mean standard deviation of the samples after each refit, (batch, iteration);
    - `iterations`: number of refits, (batch,);
    - `num_nonfinite`: number of candidates whose return was not finite, (batch,);
    - `is_fallback`: whether no candidate had a finite return or no iteration fitted the deadline, so that the actions
      are the tail of the previous plan, zeros, or the policy's, (batch,);
    - `is_policy`: whether no iteration fitted the deadline and the actions are the policy's, (batch,); false unless the
      policy makes proposals, and false with constraints or an objective for which the policy was not trained;
    - `violation`: violation of the chosen sequence, only with constraints, (batch,);
    - `stopped`: the reason the search ended, "iterations" or "deadline".

    A planner of another kind must give `is_fallback`, `is_policy` and `num_nonfinite`.

    Attributes:
        actions: The chosen sequence within the bounds, (batch, horizon, action).
        mean: Mean of the search distribution, (batch, horizon, action).
        var: Variance of the search distribution, (batch, horizon, action).
        expected_return: Predicted return, (batch,): the mean return of the last elites, or the return of the chosen
            sequence if the option `final` is `best` or `better`. NaN where no candidate had a finite return.
        info: Diagnostics by name, see above.
        elites: Kept elites, (batch, kept, horizon, action), if the planner keeps some.
        is_warm: Whether the next search may start from this plan, (batch,) bool on the CPU.
        elapsed: Number of actions executed since this plan was made, (batch,) on the CPU; the next search shifts the
            plan by this number.
    """

    actions: Tensor
    mean: Tensor
    var: Tensor
    expected_return: Tensor
    info: dict[str, Any]
    elites: Tensor | None
    is_warm: Tensor
    elapsed: Tensor

    @property
    def action(self) -> Tensor:
        """The first action of the chosen sequence, (batch, action)."""
        return self.actions[:, 0]

    def action_distribution(self, min_std: float) -> tuple[Tensor, Tensor]:
        """Returns mean and std of the search distribution over the first action, (batch, action) each.

        Args:
            min_std: Floor of the returned std.

        Returns:
            Mean and std; NaN where no candidate had a finite return.
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

        These actions are the tail of the previous plan, or zeros; a caller with a policy should execute the policy.
        """
        return (self.info["is_fallback"] & ~self.info["is_policy"]).cpu()

    def warn_of_failures(self) -> None:
        """Warns if no candidate of some environment had a finite return, so that the caller's policy acts there."""
        if bool((self.failures() & (self.info["num_nonfinite"] > 0).cpu()).any()):
            warnings.warn(
                "a search found nothing finite; the last plan or the policy acts", RuntimeWarning, stacklevel=2
            )

    def forget(self, mask: Tensor) -> Plan:
        """Returns this plan, except that the environments in mask (batch,) bool start their next search cold."""
        return replace(self, is_warm=self.is_warm & ~mask.to("cpu", torch.bool))

    def executed(self, elapsed: Tensor) -> Plan:
        """Returns this plan with `elapsed` (batch,) as the number of executed actions."""
        return replace(self, elapsed=elapsed)

    def aged(self) -> Plan:
        """Returns this plan one step later, after another agent acted; environments without actions left are cold."""
        elapsed = self.elapsed + 1
        return replace(self, elapsed=elapsed).forget(elapsed >= self.mean.shape[1])

    def take(self, rows: Tensor) -> Plan:
        """Returns the plans of the environments at rows (chosen,) int, which may repeat."""

        def select(value: Any) -> Any:
            return value[rows.to(value.device)] if isinstance(value, Tensor) else value

        info = {name: select(value) for name, value in self.info.items()}
        return Plan(info=info, **{name: select(getattr(self, name)) for name in TENSORS})

    def spread(self, mask: Tensor) -> Plan:
        """Returns these plans, in order, at the environments in mask (batch,) bool, and cold copies elsewhere."""
        return self.take((mask.cumsum(0) - 1).clamp_min(0)).forget(~mask)

    def updated(self, mask: Tensor, new: Plan) -> Plan:
        """Returns this plan, with the environments in mask (batch,) bool taken from a newer plan."""

        def select(older: Any, newer: Any) -> Any:
            if not isinstance(older, Tensor) or not isinstance(newer, Tensor) or older.shape != newer.shape:
                return newer  # diagnostics of another length exist for the newer search only
            is_newer = rearrange(mask.to(older.device), f"batch -> batch {' '.join(['1'] * (older.ndim - 1))}")
            return torch.where(is_newer, newer, older)

        info = {name: select(self.info.get(name), value) for name, value in new.info.items()}
        return Plan(info=info, **{name: select(getattr(self, name), getattr(new, name)) for name in TENSORS})


@dataclass(frozen=True)
class WarmStart:
    """The previous plan, shifted to the present.

    Attributes:
        mean: Shifted plan with its tail filled, zeros where cold, within the bounds, (batch, horizon, action).
        elites: Shifted elites, (batch, kept, horizon, action), if any were kept.
        is_warm: Environments in which the previous plan is valid, (batch,) bool on the CPU.
    """

    mean: Tensor
    elites: Tensor | None
    is_warm: Tensor


def shift_plan(
    previous: Plan,
    *,
    horizon: int,
    tail: str,
    bounds: tuple[Tensor, Tensor],
    policy_tail: Callable[[Tensor, Tensor], Tensor],
) -> WarmStart:
    """Shifts a plan by the actions executed since it was made, and fills its tail.

    Args:
        previous: The previous plan, of any length.
        horizon: Number of actions of the next plan.
        tail: How the tail is filled: `zero`, `hold` (the last action repeated) or `policy`.
        bounds: Lowest and highest action, each (action,).
        policy_tail: `policy_tail(sequence, is_tail) -> sequence` fills the tail with the model's policy.
    """
    length = previous.mean.shape[1]
    device, low, high = previous.mean.device, *bounds
    position = torch.arange(horizon)[None] + previous.elapsed[:, None]
    is_tail = (position >= length).to(device)[..., None]  # (batch, horizon, 1)
    index = position.clamp_max(length - 1).to(device)[..., None]

    def move(sequence: Tensor) -> Tensor:
        """Returns the shifted sequence in this search's precision, its last action repeated past its end (`hold`)."""
        return torch.take_along_dim(sequence, index, dim=1).to(low.dtype)

    is_warm = previous.is_warm.to(device)[:, None, None]
    mean = move(previous.actions)
    if tail == "zero":
        mean = torch.where(is_tail, 0.0, mean)
    elif tail == "policy":
        mean = policy_tail(mean, is_tail)
    mean = torch.where(is_warm, mean, 0.0).clamp(low, high)

    elites = previous.elites
    if elites is not None:
        elites = torch.take_along_dim(elites, index[:, None], dim=2).to(low.dtype)
        elites = torch.where(is_tail[:, None], mean[:, None], elites).clamp(low, high)
    return WarmStart(mean, elites, previous.is_warm)
