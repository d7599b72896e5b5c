"""What agents have in common: the protocol of every agent, and the belief of agents with a world model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from latentplan.agents.noise import CorrelatedNoise
from latentplan.config import Config
from latentplan.models import State, WorldModel
from latentplan.models.backend import FrameFunctions
from latentplan.models.symmetry import TurnedModel, first_turn, flat, folded, per_turn, turned
from latentplan.objectives.expression import Expression
from latentplan.objectives.objective import plan_goals, read_goal_image
from latentplan.planning import Planner
from latentplan.planning.objectives import Constraint, Term


class Agent(Protocol):
    """Turns frames into actions.

    An agent may have an attribute `last_source` with the origin of the most recent action: "plan", "tail" (the rest of
    an older plan) or "actor". An agent without the attribute counts as one that does not plan.
    """

    def act(self, frame: np.ndarray) -> np.ndarray:
        """The action, float32 (action,), for a frame, uint8 (height, width, channel)."""
        ...

    def reset(self) -> None:
        """Forgets the past; called before every episode."""
        ...

    def seed(self, seed: int) -> None:
        """Restarts the agent's own random stream."""
        ...


class ModelAgent:
    """An agent with a world model: keeps a belief about each environment; subclasses choose actions from it.

    The agent turns one frame (64, 64, 3) into one action (action,), or a batch of frames (batch, 64, 64, 3), one of
    each environment, into (batch, action). The belief is a state of the world model at the posterior's mean. Where
    `config.model.turns` is 4 the agent keeps one belief for each of the frame's four quarter turns.

    Attributes:
        state: The belief, `deter` (batch, deter) and `stoch` (batch, latent), or (batch, 4, ...) with four turns; None
            before the first frame.
        imagined: The world model as planners use it; its states are beliefs of this agent.
        last_source: Origin of the most recent action: "plan", "tail" (the rest of an older plan) or "actor"; a list
            where the environments of a batch can differ.
        steps_ahead: Model steps from the belief to the picture that `imagine` returned last.

    Args:
        model: The world model; put into evaluation mode and never changed.
        config: Settings the model was trained with.
        noise_std: Standard deviation of Gaussian noise added to each action, for exploration.
        noise_correlation: Correlation of that noise between one decision and the next, in [0, 1).
        seed: Seed of the agent's own random stream.
    """

    last_source: str | list[str] = "actor"
    steps_ahead: int = 0
    _frame_functions: FrameFunctions  # with the weights of the present decision

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
        self._turns = model.config.turns
        self.imagined: WorldModel | TurnedModel = model if self._turns == 1 else TurnedModel(model)
        self.seed(seed)

    def seed(self, seed: int) -> None:
        """Restarts the agent's random stream."""
        self.generator.manual_seed(seed)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forgets the past of all environments, or of those where mask (batch,) is true.

        Raises:
            ValueError: The mask has another length than the batch.
        """
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
        """The action for a new frame.

        Args:
            frame: uint8 (64, 64, 3), or (batch, 64, 64, 3) with one frame of each environment.

        Returns:
            The action in [-1, 1], float32 (action,) or (batch, action).

        Raises:
            ValueError: The frame has another shape or dtype, or the batch changed without a reset.
        """
        single = frame.ndim == 3
        frames = self._check(frame[None] if single else frame)
        self._frame_functions = self.model.backend.frame_functions(self.model)
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
        """The latent of a frame without its past, float32 (32,), or (batch, 32) for several frames."""
        single = frame.ndim == 3
        latent = self._glance(self._check(frame[None] if single else frame)).cpu().numpy()
        return latent[0] if single else latent

    def imagine(self) -> np.ndarray | None:
        """The decoded end of the first environment's plan, uint8 (32, 32, 3); None without a plan."""
        return None

    def _choose(self, state: State) -> Tensor:
        raise AssertionError("a subclass of ModelAgent defines _choose")

    def _picture(self, state: State, actions: Tensor) -> np.ndarray:
        """The decoded end of a plan (batch, horizon, action), uint8 (32, 32, 3), of the first environment."""
        first = State(*(part[:1] for part in first_turn(state)))
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
        return self._glance(turned(self._check(read_goal_image(path)[None]), self._turns))

    def _glance(self, frames: Tensor) -> Tensor:
        """Latents (batch, latent) of frames without their past."""
        return self.model.see(self.model.dynamics.initial(len(frames)).deter, frames).stoch

    def _believe(self, frames: Tensor) -> State:
        if self.state is not None and len(self.state.deter) != len(frames):
            raise ValueError(f"got {len(frames)} frames after {len(self.state.deter)}: call reset() between batches")
        frames, turns = turned(frames, self._turns), self._turns
        if self.state is None or self._action is None:
            return folded(self._see(self.model.dynamics.initial(len(frames)).deter, frames), turns)
        deter = self._frame_functions.advance(flat(self.state), per_turn(self._action, turns))
        if self._forget is not None:
            deter = torch.where(per_turn(self._forget, turns)[:, None], 0.0, deter)
        return folded(self._see(deter, frames), turns)

    def _see(self, deter: Tensor, frames: Tensor) -> State:
        return self._frame_functions.see(deter, frames)

    def _check(self, frames: np.ndarray) -> Tensor:
        if frames.dtype != np.uint8 or frames.shape[1:] != (64, 64, 3):
            raise ValueError(f"frames must be uint8 (64, 64, 3), got {frames.dtype} {frames.shape[1:]}")
        return torch.as_tensor(np.ascontiguousarray(frames), device=self.model.device)
