"""Goal conditioning: a goal actor and a goal value learn from imagined rollouts towards randomly drawn boxes.

A box holds one interval per quantity. Only the goal heads change; the rest of the agent stays bit for bit as it is.
Rollouts start from beliefs in the replay, and boxes lie around quantities observed in the replay. Every update draws
from its own random stream, so goal learning that was interrupted and resumed ends with the same agent.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any, NamedTuple, TypedDict

import torch
from torch import Tensor

from latentplan.config import GoalsConfig, LearningConfig, derive_seed
from latentplan.models import State, WorldModel
from latentplan.objectives.box import box_degree
from latentplan.replay.buffer import Replay
from latentplan.training.learner.losses import draw_noise, entropy
from latentplan.training.learner.module import Snapshot
from latentplan.training.learner.optimization import OptimizerState, descend, load_optimizer_state, return_scale

RANGE = (0.005, 0.995)  # quantiles of the observed quantities, between which box centres are moved
RANGE_ROWS = 20_000  # rows from which the quantiles are estimated
FRAMES_PER_CALL = 1024


class GoalLearnerState(TypedDict):
    """What the `state_dict` of a goal learner returns."""

    heads: dict[str, Tensor]
    target: dict[str, Tensor]
    optimizer: OptimizerState
    return_range: Tensor
    updates: int


class Boxes(NamedTuple):
    """One box per row.

    Attributes:
        low: Lower ends of the intervals, (rows, quantity); -inf for an interval without a lower end.
        high: Upper ends of the intervals, (rows, quantity); inf for an interval without an upper end.
        rows: Row of the observed quantities around which each box lies, (rows,).
    """

    low: Tensor
    high: Tensor
    rows: Tensor


class BoxSource:
    """Draws boxes around observed quantities.

    Each box has one chosen quantity and one wanted value, drawn uniformly from the range of that quantity. Three
    quarters of the boxes lie around a row whose chosen quantity is close to the wanted value, so that rare values are
    frequent goals. The other boxes lie around a row drawn uniformly. In a quarter of all boxes the centre of the chosen
    quantity then moves to the wanted value. Each interval is a point, open above, open below, closed with a width of up
    to one scale, or open on both sides; the interval of the chosen quantity is never open on both sides.

    Args:
        observed: Observed quantities, (row, quantity).
        scales: Typical size of each quantity, (quantity,).
        generator: Random stream, on the device of `observed`.
    """

    def __init__(self, observed: Tensor, scales: Tensor, generator: torch.Generator) -> None:
        self.observed, self.scales = observed, scales
        some = observed[torch.randperm(len(observed), generator=generator, device=observed.device)[:RANGE_ROWS]]
        self.span = torch.quantile(some, some.new_tensor(RANGE), dim=0)
        self._sorted, self._order = observed.t().contiguous().sort(dim=1)

    def draw(self, num: int, generator: torch.Generator) -> Boxes:
        """Draws `num` random boxes."""
        size, device = (num, self.observed.shape[1]), self.observed.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(shape, generator=generator, device=device)

        chosen = torch.randint(size[1], (num, 1), generator=generator, device=device)
        is_chosen = torch.arange(size[1], device=device) == chosen
        wanted = self.span[0] + (self.span[1] - self.span[0]) * uniform(*size)
        rows = torch.randint(len(self.observed), (num,), generator=generator, device=device)
        rows = torch.where(uniform(num) < 0.75, self._nearest(chosen, wanted), rows)
        centre = torch.where((uniform(num, 1) < 0.25) & is_chosen, wanted, self.observed[rows])
        kind = uniform(*size)
        kind = torch.where(is_chosen, 0.3 + 0.7 * kind, kind)  # open on both sides below 0.3
        half = 0.5 * self.scales * torch.where(kind >= 0.9, uniform(*size), 0.0)
        has_low = ((kind >= 0.3) & (kind < 0.7)) | (kind >= 0.9)
        has_high = ((kind >= 0.3) & (kind < 0.5)) | (kind >= 0.7)
        low = torch.where(has_low, centre - half, -math.inf)
        return Boxes(low, torch.where(has_high, centre + half, math.inf), rows)

    def _nearest(self, chosen: Tensor, wanted: Tensor) -> Tensor:
        """Finds for each box a row whose chosen quantity is close to the wanted value.

        Args:
            chosen: Index of the chosen quantity, (box, 1).
            wanted: Wanted value of every quantity, (box, quantity).

        Returns:
            Rows of `observed`, (box,).
        """
        places = torch.searchsorted(self._sorted, wanted.t().contiguous()).clamp_max(len(self.observed) - 1)
        rows = self._order.gather(1, places).t()  # (box, quantity)
        return rows.gather(1, chosen).squeeze(1)


class GoalLearner:
    """Learns the goal actor and the goal value from imagined rollouts, as behaviour is learned for the reward.

    Args:
        model: World model with goal heads; only the goal heads change.
        settings: Settings of goal learning.
        learning: Settings with which the agent learned; lambda, gradient clipping and the target's rate are reused.
        discount: Discount per decision.
        frames_per_step: Simulator frames per decision.
        replay: Source of the beliefs from which rollouts start, and of the observed quantities.
    """

    def __init__(
        self,
        model: WorldModel,
        settings: GoalsConfig,
        learning: LearningConfig,
        discount: float,
        frames_per_step: int,
        replay: Replay,
    ) -> None:
        self.model, self.settings, self.learning = model, settings, learning
        self.discount, self.frames_per_step = discount, frames_per_step
        self.updates, self.return_range = 0, torch.zeros((), device=model.device)
        self.frozen_model = Snapshot(model, model.trunk_dtype).model
        self.target = copy.deepcopy(model.goal_heads).requires_grad_(False)
        parameters = [*model.goal_heads.requires_grad_(True).parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=settings.learning_rate, eps=1e-6, fused=True)
        rows = torch.from_numpy(replay.episode >= 0).nonzero().squeeze(1)
        self.beliefs = _infer_beliefs(model, replay, rows)
        observed = replay.labels[rows][:, : len(model.goal_names)].to(model.device)
        self.source = BoxSource(observed, model.goal_scales, self._generator("span"))

    def update(self) -> dict[str, float]:
        """Updates the goal actor and the goal value once.

        Returns:
            `worth`, the mean degree in [0, 1] to which imagined states lie in their boxes, and the actor's `entropy` in
            nats.

        Raises:
            FloatingPointError: The gradient is not finite.
        """
        settings, heads, scales = self.settings, self.model.goal_heads, self.model.goal_scales
        generator = self._generator("update", self.updates)
        low, high, rows = self.source.draw(settings.starts, generator)
        code = heads.encode(low, high)
        with self.model.trunk_precision():
            start = self._starts(rows, generator)
            features, entropies = self.imagine(start, code, generator)
            degrees = box_degree(low, high, self.model.goal_quantities(features[1:]), scales)  # (horizon, rows)
            values = self.target.value(features[1:], code)
        discounts = torch.full_like(degrees, self.discount)
        returns = self.model.backend.lambda_return(
            self.frames_per_step * degrees, discounts, values, self.learning.lambda_
        )
        reach = torch.cat([torch.ones_like(discounts[:1]), discounts[:-1]]).cumprod(0)
        gains = returns / return_scale(self.return_range, returns.detach()) + settings.entropy_scale * entropies
        with self.model.trunk_precision():
            logits = heads.value_logits(features[:-1].detach(), code)
        loss = (reach * (heads.value_head.loss(logits, returns.detach()) - gains)).mean()
        descend(self.optimizer, loss, self.learning.max_grad_norm, self.updates)
        self.model.backend.move_towards([*self.target.parameters()], [*heads.parameters()], self.learning.target_rate)
        self.updates += 1
        return {"worth": float(degrees.detach().mean()), "entropy": float(entropies.detach().mean())}

    def imagine(self, start: State, code: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Imagined rollouts of the goal actor.

        Args:
            start: States from which the rollouts start, (rows, ...).
            code: Codes of the boxes, (rows, code), from `GoalHeads.encode`.
            generator: Random stream of the actions and latents.

        Returns:
            Features of the states, the start first, (horizon + 1, rows, feature), and entropies of the actions in nats,
            (horizon, rows).
        """
        act = partial(self.model.goal_action, code=code)
        noise = draw_noise(self.frozen_model, self.settings.horizon, len(start.deter), generator)
        features, std = self.frozen_model.dynamics.imagine(act, start, *noise)
        return features, entropy(std)

    def state_dict(self) -> dict[str, Any]:
        """The states of goal heads, target and optimizer, and the counters."""
        return {
            "heads": self.model.goal_heads.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "return_range": self.return_range,
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned.

        Raises:
            RuntimeError: The weights belong to goal heads of other sizes.
            UserError: The state of the optimizer belongs to other parameters.
        """
        self.model.goal_heads.load_state_dict(state["heads"])
        self.target.load_state_dict(state["target"])
        load_optimizer_state(self.optimizer, state["optimizer"])
        self.return_range, self.updates = state["return_range"].to(self.model.device), state["updates"]

    def _generator(self, name: str, counter: int = 0) -> torch.Generator:
        return torch.Generator(self.model.device).manual_seed(derive_seed(self.settings.seed, name, counter))

    def _starts(self, rows: Tensor, generator: torch.Generator) -> State:
        """Draws the beliefs from which rollouts start: half at the rows around which the boxes lie, half at any row.

        The actor learns from the first half to stay in a box, and from the second half to reach a box.

        Args:
            rows: Row of the replay around which each box lies, (rows,).
            generator: Random stream of the draw.
        """
        size, device = (len(rows),), self.model.device
        anywhere = torch.randint(len(self.beliefs.deter), size, generator=generator, device=device)
        is_inside = torch.rand(size, generator=generator, device=device) < 0.5
        chosen = torch.where(is_inside, rows, anywhere)
        return State(*(part[chosen] for part in self.beliefs))


@torch.no_grad()
def _infer_beliefs(model: WorldModel, replay: Replay, rows: Tensor) -> State:
    """Computes the beliefs at rows (n,) of a replay from the stored deterministic states and frames, (n, ...) each."""
    beliefs = [
        model.see(replay.deter[part].float().to(model.device), replay.frames[part].to(model.device))
        for part in rows.split(FRAMES_PER_CALL)
    ]
    return State(*(torch.cat(part) for part in zip(*beliefs, strict=True)))
