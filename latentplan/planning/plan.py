"""The result of a search, as a value: planners keep nothing between calls, callers pass the last plan on."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from einops import rearrange
from torch import Tensor


@dataclass(frozen=True)
class Plan:
    """What a search found, for every environment in the call.

    Attributes:
        actions: The chosen sequence within the bounds, (batch, horizon, action).
        mean: Mean of the search distribution, (batch, horizon, action).
        var: Variance of the search distribution, (batch, horizon, action).
        expected_return: Predicted return of what the choice rests on, (batch,): of the last elites on average, or of
            the executed sequence where it was chosen (`final` best or better). NaN where nothing finite was found.
        info: Diagnostics, (batch,) or (batch, iteration), and what stopped the search; see `CEMPlanner.plan`.
        elites: Kept elites, (batch, kept, horizon, action), when the planner keeps some.
        is_warm: Whether the next search may start here, (batch,) bool on the CPU.
        elapsed: Actions executed since this plan was made, (batch,) on the CPU; the next search shifts by as many.
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
        """Mean and std of the search distribution over the first action, (batch, action) each; std at least `min_std`.

        NaN where no candidate had a finite return: nothing was searched there.
        """
        failed = self.info["is_fallback"][:, None]
        std = self.var[:, 0].sqrt().clamp_min(min_std)
        return self.mean[:, 0].masked_fill(failed, torch.nan), std.masked_fill(failed, torch.nan)

    @property
    def source(self) -> str:
        """Whose the first environment's actions are: "plan"; or, without a search, "tail" (of the last) or "actor"."""
        if not bool(self.info["is_fallback"][0]):
            return "plan"
        return "actor" if bool(self.info["is_policy"][0]) else "tail"

    def failures(self) -> Tensor:
        """Where neither a search nor a policy stands behind the actions, (batch,) bool on the CPU.

        Whoever has a policy had better follow that than what is left there of the last plan, or zeros.
        """
        return (self.info["is_fallback"] & ~self.info["is_policy"]).cpu()

    def warn_of_failures(self) -> None:
        """Warns where nothing finite was found, and a policy acts instead."""
        if bool((self.failures() & (self.info["num_nonfinite"] > 0).cpu()).any()):
            warnings.warn("a search found nothing finite; the policy acts", RuntimeWarning, stacklevel=2)

    def forget(self, mask: Tensor) -> Plan:
        """The same plan, except that environments in mask (batch,) bool start their next search cold."""
        return replace(self, is_warm=self.is_warm & ~mask.to("cpu", torch.bool))

    def executed(self, elapsed: Tensor) -> Plan:
        """The same plan, `elapsed` (batch,) of whose actions have been executed."""
        return replace(self, elapsed=elapsed)

    def aged(self) -> Plan:
        """The same plan one step later, in which somebody else acted; where it has run out the next search is cold."""
        elapsed = self.elapsed + 1
        return replace(self, elapsed=elapsed).forget(elapsed >= self.mean.shape[1])

    def take(self, rows: Tensor) -> Plan:
        """The plans of some environments, rows (chosen,) int; one may be taken more than once."""

        def pick(value: Any) -> Any:
            return value[rows.to(value.device)] if isinstance(value, Tensor) else value

        fields = ("actions", "mean", "var", "expected_return", "elites", "is_warm", "elapsed")
        info = {name: pick(value) for name, value in self.info.items()}
        return Plan(info=info, **{name: pick(getattr(self, name)) for name in fields})

    def spread(self, mask: Tensor) -> Plan:
        """These plans as those of the environments in mask (batch,) bool, in order; the others' are cold copies."""
        return self.take((mask.cumsum(0) - 1).clamp_min(0)).forget(~mask)

    def updated(self, mask: Tensor, new: Plan) -> Plan:
        """This plan, with the environments in mask (batch,) bool taken from a newer one."""

        def choose(old: Any, fresh: Any) -> Any:
            if not isinstance(old, Tensor) or not isinstance(fresh, Tensor) or old.shape != fresh.shape:
                return fresh  # diagnostics of another length describe the newer search only
            chosen = rearrange(mask.to(old.device), f"batch -> batch {' '.join(['1'] * (old.ndim - 1))}")
            return torch.where(chosen, fresh, old)

        info = {name: choose(self.info.get(name), value) for name, value in new.info.items()}
        fields = ("actions", "mean", "var", "expected_return", "elites", "is_warm", "elapsed")
        return Plan(info=info, **{name: choose(getattr(self, name), getattr(new, name)) for name in fields})


@dataclass(frozen=True)
class WarmStart:
    """The last plan, moved to the present.

    Attributes:
        mean: Shifted plan with its tail filled, zeros where cold, within the bounds, (batch, horizon, action).
        elites: Shifted elites, (batch, kept, horizon, action), if any were kept.
        is_warm: (batch,) bool on the CPU.
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
    """Moves a plan forward by the actions executed since, and fills what that leaves open at its end.

    Args:
        previous: The last plan, of any length.
        horizon: Actions of the next one.
        tail: `zero`, `hold` (the last action again) or `policy`.
        bounds: Lowest and highest action, each (action,).
        policy_tail: `policy_tail(sequence, is_tail) -> sequence` fills by the model's policy.
    """
    length = previous.mean.shape[1]
    device, low, high = previous.mean.device, *bounds
    position = torch.arange(horizon)[None] + previous.elapsed[:, None]
    is_tail = (position >= length).to(device)[..., None]  # (batch, horizon, 1)
    index = position.clamp_max(length - 1).to(device)[..., None]

    def move(sequence: Tensor) -> Tensor:
        """In this search's precision; past its end this repeats the last action: `hold`."""
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
