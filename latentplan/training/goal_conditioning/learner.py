"""Goals learned before they are named: an actor and a value for boxes drawn at random, in the imagination of a model.

The world model, and all else that an agent has, stays bit for bit. Beliefs to start from come from the run's replay,
boxes from the quantities that were met in it. Every update draws from a random stream of its own, so that a learning
that was interrupted goes on as if nothing had happened.
"""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from latentplan.config import GoalsConfig, LearningConfig, derive_seed
from latentplan.models import State, WorldModel
from latentplan.objectives.box import box_degree
from latentplan.replay.buffer import Replay
from latentplan.training.learner.losses import draw_noise, entropy, lambda_return
from latentplan.training.learner.optimization import descend, return_scale
from latentplan.training.learner.snapshot import Snapshot

RANGE = (0.005, 0.995)  # quantiles of what was met, between which ends of intervals are drawn
RANGE_ROWS = 20_000
SEEN_AT_ONCE = 1024


class Boxes(NamedTuple):
    """One box per row.

    Attributes:
        low: Lower ends of the intervals, (rows, quantity), -inf where open.
        high: Upper ends, inf where open.
        rows: Where the quantities were met that each box lies around, (rows,).
    """

    low: Tensor
    high: Tensor
    rows: Tensor


class BoxSource:
    """Draws boxes around what was met.

    Three quarters lie around rows that are drawn so that every quantity takes all of its values equally often, in the
    company that it was met in: what a body does rarely has to be asked for often to be learned. The others lie around
    any row. In a quarter of all boxes one quantity is then moved to anywhere between the rarest values that were met.
    Each interval becomes a point, open above, open below, one of up to a scale across, or, unless its quantity is the
    one that counts most in its box, open on both sides.

    Args:
        met: Quantities that were met, (row, quantity).
        scales: Typical size of each quantity, (quantity,).
        generator: Random stream, where `met` lives.
    """

    def __init__(self, met: Tensor, scales: Tensor, generator: torch.Generator) -> None:
        self.met, self.scales = met, scales
        some = met[torch.randperm(len(met), generator=generator, device=met.device)[:RANGE_ROWS]]
        self.span = torch.quantile(some, some.new_tensor(RANGE), dim=0)
        self._sorted, self._order = met.t().contiguous().sort(dim=1)

    def draw(self, num: int, generator: torch.Generator) -> Boxes:
        """So many boxes."""
        size, device = (num, self.met.shape[1]), self.met.device

        def uniform(*shape: int) -> Tensor:
            return torch.rand(shape, generator=generator, device=device)

        chosen = torch.randint(size[1], (num, 1), generator=generator, device=device)
        is_chosen = torch.arange(size[1], device=device) == chosen
        wanted = self.span[0] + (self.span[1] - self.span[0]) * uniform(*size)
        rows = torch.randint(len(self.met), (num,), generator=generator, device=device)
        rows = torch.where(uniform(num) < 0.75, self._nearest(chosen, wanted), rows)
        centre = torch.where((uniform(num, 1) < 0.25) & is_chosen, wanted, self.met[rows])
        kind = uniform(*size)
        kind = torch.where(is_chosen, 0.3 + 0.7 * kind, kind)  # open on both sides below 0.3
        half = 0.5 * self.scales * torch.where(kind >= 0.9, uniform(*size), 0.0)
        has_low = ((kind >= 0.3) & (kind < 0.7)) | (kind >= 0.9)
        has_high = ((kind >= 0.3) & (kind < 0.5)) | (kind >= 0.7)
        low = torch.where(has_low, centre - half, -math.inf)
        return Boxes(low, torch.where(has_high, centre + half, math.inf), rows)

    def _nearest(self, chosen: Tensor, wanted: Tensor) -> Tensor:
        """For each box a row where its chosen quantity (box, 1) has about the wanted value (box, quantity), (box,)."""
        places = torch.searchsorted(self._sorted, wanted.t().contiguous()).clamp_max(len(self.met) - 1)
        rows = self._order.gather(1, places).t()  # (box, quantity)
        return rows.gather(1, chosen).squeeze(1)


class GoalLearner:
    """Learns an actor and a value for boxes by imagining, as behaviour is learned for the reward.

    Args:
        model: The world model, with heads for goals; nothing but these changes.
        settings: Of the learning of goals.
        learning: How the agent itself learned: the mixing of returns, the clipping and the slow copy are as there.
        discount: Per decision.
        frames_per_step: Env frames per decision.
        replay: Where beliefs to start from, and the quantities met, come from.
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
        self.dream = Snapshot(model).model
        self.target = copy.deepcopy(model.goal_heads).requires_grad_(False)
        parameters = [*model.goal_heads.requires_grad_(True).parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=settings.learning_rate, eps=1e-6, fused=True)
        rows = torch.from_numpy(replay.episode.reshape(-1) >= 0).nonzero().squeeze(1)
        self.beliefs = _see_all(model, replay, rows)
        met = replay.labels[rows][:, : len(model.goal_names)].to(model.device)
        self.source = BoxSource(met, model.goal_scales, self._generator("span"))

    def update(self) -> dict[str, float]:
        """One step of actor and value; what it came to.

        Returns:
            `worth`, the mean degree to which imagined states lie in their boxes, and `entropy` in nats.

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
            worth = box_degree(low, high, self.model.goal_quantities(features[1:]), scales)
            values = self.target.value(features[1:], code)
        discounts = torch.full_like(worth, self.discount)
        returns = self.model.backend.call(
            lambda_return, self.frames_per_step * worth, discounts, values, self.learning.lambda_
        )
        reach = torch.cat([torch.ones_like(discounts[:1]), discounts[:-1]]).cumprod(0)
        gains = returns / return_scale(self.return_range, returns.detach()) + settings.entropy_scale * entropies
        with self.model.trunk_precision():
            logits = heads.value_logits(features[:-1].detach(), code)
        loss = (reach * (heads.value_head.loss(logits, returns.detach()) - gains)).mean()
        descend(self.optimizer, loss, self.learning.max_grad_norm, self.updates)
        self.model.backend.move_towards([*self.target.parameters()], [*heads.parameters()], self.learning.target_rate)
        self.updates += 1
        return {"worth": float(worth.detach().mean()), "entropy": float(entropies.detach().mean())}

    def imagine(self, start: State, code: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """What the actor for the boxes of a code does from rows of states; see `Dynamics.imagine`."""
        act = partial(self.model.goal_action, code=code)
        noise = draw_noise(self.dream, self.settings.horizon, len(start.deter), generator)
        features, std = self.dream.dynamics.imagine(act, start, *noise)
        return features, entropy(std)

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {
            "heads": self.model.goal_heads.state_dict(),
            "target": self.target.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "return_range": self.return_range,
            "updates": self.updates,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up what `state_dict` gave."""
        self.model.goal_heads.load_state_dict(state["heads"])
        self.target.load_state_dict(state["target"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.return_range, self.updates = state["return_range"].to(self.model.device), state["updates"]

    def _generator(self, name: str, counter: int = 0) -> torch.Generator:
        return torch.Generator(self.model.device).manual_seed(derive_seed(self.settings.seed, name, counter))

    def _starts(self, rows: Tensor, generator: torch.Generator) -> State:
        """Beliefs where imagination starts: half of them where what the box lies around was met, the others anywhere.

        From the first it is learned to stay in a box, from the others to get there.
        """
        size, device = (len(rows),), self.model.device
        anywhere = torch.randint(len(self.beliefs.deter), size, generator=generator, device=device)
        is_there = torch.rand(size, generator=generator, device=device) < 0.5
        chosen = torch.where(is_there, rows, anywhere)
        return State(*(part[chosen] for part in self.beliefs))


@torch.no_grad()
def _see_all(model: WorldModel, replay: Replay, rows: Tensor) -> State:
    """The beliefs at rows of a replay: the model stays as it is, so that once is enough."""
    seen = [
        model.see(replay.deter[part].float().to(model.device), replay.frames[part].to(model.device))
        for part in rows.split(SEEN_AT_ONCE)
    ]
    return State(*(torch.cat(part) for part in zip(*seen, strict=True)))
