"""Agents: a world model, and a way to choose actions with it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.noise import CorrelatedNoise
from latentplan.config import Config
from latentplan.models import State, WorldModel
from latentplan.models.fast import reflex
from latentplan.models.symmetry import TurnedModel, flat, folded, per_turn, turned, unturned
from latentplan.objectives.expression import Expression
from latentplan.objectives.image import read_goal
from latentplan.objectives.objective import plan_goals
from latentplan.planning import Planner
from latentplan.planning.objectives import Constraint, Term


class ModelAgent:
    """What planning and acting agents share: a belief that follows the frames.

    One frame (64, 64, 3) in gives one action (action,) out; several, (batch, 64, 64, 3), give (batch, action).
    The belief is the posterior's mean, of the frame alone or (`model.turns`) of its four quarter turns.

    Attributes:
        state: The belief, `deter` (batch, deter) and `stoch` (batch, latent); (batch, 4, ...) where it is of all turns.
        imagined: The world model as planners see it, whose states are these beliefs.
        last_source: Of the latest action, "plan", "tail" (of an older plan) or "actor"; a list where these can differ.
        steps_ahead: Model steps from the belief to what `imagine` pictured last.

    Args:
        model: The world model; put into evaluation mode and never changed.
        config: Settings it was trained with.
        noise_std: Standard deviation of Gaussian noise added to each action, for exploration.
        noise_correlation: Of that noise between one decision and the next, in [0, 1).
        seed: Of the agent's own random stream.
    """

    last_source: str | list[str] = "actor"
    steps_ahead: int = 0

    def __init__(
        self,
        model: WorldModel,
        config: Config,
        *,
        noise_std: float = 0.0,
        noise_correlation: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.model, self.config = model.eval(), config
        self.noise_std, self.noise = noise_std, CorrelatedNoise(noise_correlation)
        self.num_actions = model.action_dim
        self.generator = torch.Generator(model.device)
        self.state: State | None = None
        self._action: Tensor | None = None
        self._forget: Tensor | None = None
        self._weights = reflex.lay_out(model)
        self._turns = model.config.turns
        self.imagined: WorldModel | TurnedModel = model if self._turns == 1 else TurnedModel(model)
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restart the agent's random stream."""
        self.generator.manual_seed(seed)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the past, everywhere or in the environments where mask (batch,) is true."""
        if mask is None or self.state is None:
            self.state = self._action = self._forget = None
            self.noise.reset()
        else:
            forget = torch.tensor(mask, dtype=torch.bool, device=self.model.device)
            if len(forget) != len(self.state.deter):
                raise ValueError(f"got a mask of {len(forget)} for {len(self.state.deter)} environments")
            self._forget = forget if self._forget is None else self._forget | forget

    @torch.no_grad()
    def act(self, frame: np.ndarray) -> np.ndarray:
        """The action in [-1, 1], float32 (action,) or (batch, action), for uint8 frame(s).

        Raises:
            ValueError: The frame has another shape or dtype, or the batch changed without a reset.
        """
        single = frame.ndim == 3
        frames = self._check(frame[None] if single else frame)
        state = self._believe(frames)
        action = self._choose(state)
        if self.noise_std > 0.0:
            noise = self.noise.draw(action, self.generator, self._forget)
            action = (action + self.noise_std * noise).clamp(-1.0, 1.0)
        self.state, self._action, self._forget = state, action, None
        result = action.float().cpu().numpy()
        return result[0] if single else result

    @torch.no_grad()
    def encode(self, frame: np.ndarray) -> np.ndarray:
        """The latent of one frame seen without a past, float32 (32,), or (batch, 32) for several."""
        single = frame.ndim == 3
        latent = self._glance(self._check(frame[None] if single else frame)).cpu().numpy()
        return latent[0] if single else latent

    def imagine(self) -> np.ndarray | None:
        """The picture an agent looks forward to, uint8 (32, 32, 3); None without a plan."""
        return None

    def _choose(self, state: State) -> Tensor:
        raise AssertionError("an agent defines how it chooses")

    def _picture(self, state: State, actions: Tensor) -> np.ndarray:
        """The decoded end of a plan (batch, horizon, action), uint8 (32, 32, 3), of the first environment."""
        first = State(*(part[:1] for part in unturned(state)))
        self.steps_ahead = actions.shape[1]
        _, last = self.model.rollout(first, actions[:1].to(first.deter.dtype))
        return self.model.decoder.picture(last.features.float())[0].cpu().numpy()

    def _plan_goals(
        self, objective: str | Expression | Term | None, constraints: str | Sequence[Constraint], planner: Planner
    ) -> tuple[Term | None, Sequence[Constraint]]:
        return plan_goals(
            objective,
            constraints,
            model=self.model,
            env=self.config.env,
            planner=planner,
            encode_goal=self._encode_goal,
        )

    def _encode_goal(self, path: str) -> Tensor:
        """The latents of a picture's turns, (turn, latent)."""
        return self._glance(turned(self._check(read_goal(path)[None]), self._turns))

    def _glance(self, frames: Tensor) -> Tensor:
        """Latents (batch, latent) of frames seen without a past."""
        return self.model.see(self.model.dynamics.initial(len(frames)).deter, frames).stoch

    def _believe(self, frames: Tensor) -> State:
        if self.state is None or self.model.device.type != "cpu":  # elsewhere the weights do not follow the model's
            self._weights = reflex.lay_out(self.model)
        if self.state is not None and len(self.state.deter) != len(frames):
            raise ValueError(f"got {len(frames)} frames after {len(self.state.deter)}: call reset() between batches")
        frames, turns = turned(frames, self._turns), self._turns
        if self.state is None or self._action is None:
            return folded(self._see(self.model.dynamics.initial(len(frames)).deter, frames), turns)
        deter = reflex.advance(self._weights, flat(self.state), per_turn(self._action, turns))
        if self._forget is not None:
            deter = torch.where(per_turn(self._forget, turns)[:, None], 0.0, deter)
        return folded(self._see(deter, frames), turns)

    def _see(self, deter: Tensor, frames: Tensor) -> State:
        return reflex.see(self._weights, deter, frames)

    def _check(self, frames: np.ndarray) -> Tensor:
        if frames.dtype != np.uint8 or frames.shape[1:] != (64, 64, 3):
            raise ValueError(f"frames must be uint8 (64, 64, 3), got {frames.dtype} {frames.shape[1:]}")
        return torch.as_tensor(np.ascontiguousarray(frames), device=self.model.device)
