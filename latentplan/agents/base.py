"""Common parts of all agents: the protocol of an agent, and the base class of agents with a world model."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from einops import rearrange
from torch import Tensor

from latentplan.config import Config, UserError
from latentplan.models import State, WorldModel
from latentplan.models.backend import FrameFunctions
from latentplan.models.encoder import Observation
from latentplan.models.heads import MixedActor
from latentplan.models.symmetry import TurnedModel, first_turn, flat, folded, mean_over_turns, per_turn, turned
from latentplan.objectives.expression import Expression
from latentplan.objectives.goal_image import read_goal_image
from latentplan.objectives.objective import build_goals
from latentplan.planning import Planner
from latentplan.planning.objectives import Constraint, Term

Seen = np.ndarray | tuple[np.ndarray, np.ndarray]
"""A frame, or a frame and the numbers beside it, float32 (vector,); a batch of both has the rows in front."""


def frame_of(seen: Seen) -> np.ndarray:
    """The frame, or the batch of frames, of what an agent sees."""
    return seen[0] if isinstance(seen, tuple) else seen


class Agent(Protocol):
    """Turns frames into actions.

    An agent may have an attribute `last_source` with the origin of the most recent action: "plan", "tail" (the rest of
    an older plan) or "actor". The actions of an agent without the attribute are counted as "actor".
    """

    def act(self, frame: Seen) -> np.ndarray:
        """The action, float32 (action,), for a frame, uint8 (height, width, channel), perhaps with vectors."""
        ...

    def reset(self) -> None:
        """Forgets the past; has to be called before every episode."""
        ...

    def seed(self, seed: int) -> None:
        """Restarts the agent's own random stream."""
        ...


class Imagined(NamedTuple):
    """Imagined rollouts.

    Attributes:
        pictures: The decoded state after each step that is shown, uint8 (rollout, shown, height / 2, width / 2, 3).
        rewards: The predicted reward of each step, float32 (rollout, step).
        actions: The action of each step, float32 (rollout, step, action).
    """

    pictures: np.ndarray
    rewards: np.ndarray
    actions: np.ndarray


class ModelAgent:
    """An agent with a world model: keeps a belief about each environment, from which subclasses choose the action.

    Frames have another shape than (64, 64, 3) where `model.spaces` says so.

    The agent turns one frame (64, 64, 3) into one action (action,), or a batch with one frame of each environment
    (batch, 64, 64, 3) into actions (batch, action). The belief is a state of the world model at the posterior's mean.
    Where `config.model.turns` is 4, the agent keeps one belief for each of the frame's four quarter turns.

    Attributes:
        state: The belief, `deter` (batch, deter) and `stoch` (batch, latent), or (batch, 4, ...) with four turns; None
            before the first frame.
        imagined: The world model for planners; its states have the shape of the agent's belief.
        last_source: Origin of the most recent action: "plan", "tail" (the rest of an older plan) or "actor"; a list
            where the environments of a batch can differ.
        steps_ahead: Model steps from the belief to the picture of the latest `imagine`.
        num_replaced_actions: Actions that were not finite so far, in which the last finite action of the environment
            (zeros where there is none) took their place.

    Args:
        model: The world model; the agent puts it into evaluation mode and does not change its weights.
        config: Settings the model was trained with.
        noise_std: Standard deviation of Gaussian noise added to each action, for exploration; of numbers that stand for
            a category, the probability that the category is drawn anew, all being equally likely.
        noise_correlation: Correlation of this noise between one decision and the next, in [0, 1).
        seed: Seed of the agent's own random stream.
    """

    last_source: str | list[str] = "actor"
    steps_ahead: int = 0
    num_replaced_actions: int = 0
    _frame_functions: FrameFunctions  # with the weights of the present decision
    _without_gradients: type[torch.no_grad] | type[torch.inference_mode] = torch.no_grad

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
        self._is_reset: Tensor | None = None
        self._turns = model.config.turns
        self.imagined: WorldModel | TurnedModel = model if self._turns == 1 else TurnedModel(model)
        self.seed(seed)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_frame_functions"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._frame_functions = self.model.backend.frame_functions(self.model)

    def seed(self, seed: int) -> None:
        """Restarts the agent's random stream."""
        self.generator.manual_seed(seed)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forgets the past of all environments, or only of environments where mask (batch,) is true.

        Raises:
            ValueError: The mask has another length than the batch.
        """
        if mask is None or self.state is None:
            self.state = self._action = self._is_reset = None
            self.noise.reset()
        else:
            forget = torch.tensor(mask, dtype=torch.bool, device=self.model.device)
            if len(forget) != len(self.state.deter):
                raise ValueError(f"got a mask of {len(forget)} for {len(self.state.deter)} environments")
            self._is_reset = forget if self._is_reset is None else self._is_reset | forget

    def memory(self) -> dict[str, Any]:
        """A copy of what the agent knows of the running episodes: tensors on the CPU, None and plain values.

        An agent with the same weights and settings to which `set_memory` gives it, and whose random stream is restarted
        with the same seed, acts as this agent does from here on. The gate of a `GatedAgent` and the plans of a
        `BackgroundAgent` are not part of it.
        """
        belief = None if self.state is None else [copy_tensor(part) for part in self.state]
        parts = {"action": self._action, "is_reset": self._is_reset, "noise": self.noise.last}
        return {"state": belief} | {name: copy_tensor(part) for name, part in parts.items()}

    def set_memory(self, memory: dict[str, Any]) -> None:
        """Gives the agent what another one knew of the running episodes; see `memory`."""
        device, belief = self.model.device, memory["state"]
        self.state = None if belief is None else State(*(part.to(device) for part in belief))
        action, is_reset, noise = (memory[name] for name in ("action", "is_reset", "noise"))
        self._action = None if action is None else action.to(device)
        self._is_reset = None if is_reset is None else is_reset.to(device)
        self._frame_functions = self.model.backend.frame_functions(self.model)
        self.noise.last = None if noise is None else noise.to(device)

    def act(self, frame: Seen) -> np.ndarray:
        """The action for a new frame.

        Args:
            frame: uint8 (64, 64, 3), or (batch, 64, 64, 3) with one frame of each environment. An agent that learned
                with `env.vectors` takes a pair: the frame, and `info["vectors"]` of the environment, (vector,) or
                (batch, vector).

        Returns:
            The action in [-1, 1], float32 (action,) or (batch, action), in memory of its own. It is always finite:
            where the weights give NaN or infinity, the last finite action of the environment, or zeros, is returned
            with a warning.

        Raises:
            ValueError: The frame has another shape or dtype, or the batch changed without a reset.
        """
        single = frame_of(frame).ndim == 3
        with self._without_gradients():
            frames = self._check_seen(frame, single)
            self._frame_functions = self.model.backend.frame_functions(self.model)
            state = self._update_belief(frames)
            action = self._choose(state)
            if self.noise_std > 0.0:
                noise = self.noise.draw(action, self.generator, self._is_reset)
                action = self._explore(action, noise)
            result = action.float().cpu().numpy().copy()  # the caller may change it, and the agent keeps the action
            if not np.isfinite(result).all():
                result = self._replace_actions(result)
                action = torch.tensor(result, device=self.model.device)
            self.state, self._action, self._is_reset = state, action, None
        return result[0] if single else result

    @torch.no_grad()
    def encode(self, frame: Seen) -> np.ndarray:
        """The latent of a frame at the first moment of an episode, float32 (32,), or (batch, 32) for several frames."""
        single = frame_of(frame).ndim == 3
        latent = self._encode_frames(self._check_seen(frame, single)).cpu().numpy()
        return latent[0] if single else latent

    def plan_actions(self) -> Tensor | None:
        """What is left of the first environment's plan, from the latest action on, (1, step, action); None without."""
        return None

    @torch.no_grad()
    def imagine(self) -> np.ndarray | None:
        """The decoded last state of the first environment's plan, uint8 (32, 32, 3); None without a plan.

        Also sets `steps_ahead`.
        """
        actions = self.plan_actions()
        if actions is None or self.state is None:
            return None
        first = State(*(part[:1] for part in first_turn(self.state)))
        self.steps_ahead = actions.shape[1]
        _, last = self.model.rollout(first, actions.to(first.deter.dtype))
        return self.model.decoder.picture(last.features.float())[0].cpu().numpy()

    @torch.no_grad()
    def actor_action(self) -> np.ndarray:
        """The actor's action at the first environment's latest frame, float32 (action,), whatever the agent did."""
        assert self.state is not None, "actor_action() needs a frame before it"
        return self._act_by_actor(self.state)[0].float().cpu().numpy()

    @torch.no_grad()
    def surprise(self) -> float:
        """The surprise of the first environment's latest frame in nats, mean over turns; see `WorldModel.surprise`."""
        assert self.state is not None, "surprise() needs a frame before it"
        return float(mean_over_turns(self._frame_functions.surprise(flat(self.state)), self.state)[0])

    def belief(self) -> State:
        """The belief about the first environment's latest frame, unrotated: `deter` (1, deter), `stoch` (1, latent)."""
        assert self.state is not None, "belief() needs a frame before it"
        return State(*(part[:1].float() for part in first_turn(self.state)))

    @torch.no_grad()
    def imagine_along(
        self, beliefs: Sequence[State], actions: np.ndarray | None, steps: int, shown: Sequence[int] | None = None
    ) -> Imagined:
        """Rollouts of the model from beliefs, in pictures.

        Args:
            beliefs: Results of `belief`, one for each rollout, or a single one for all of them.
            actions: Actions (rollout, step, action); None lets the actor act in each rollout.
            steps: Model steps.
            shown: Steps that are decoded, from 0, in order; None decodes all.
        """
        num = len(beliefs) if actions is None else len(actions)
        state = State(*(torch.cat(parts) for parts in zip(*beliefs, strict=True)))
        state = State(*(part.expand(num, -1).contiguous() for part in state))
        if actions is None:
            mode = torch.zeros(num, steps, self.num_actions, device=self.model.device, dtype=torch.float32)
            given = self.model.backend.propose(self.model, state, mode)
        else:
            given = torch.as_tensor(actions, dtype=torch.float32, device=self.model.device)
        features, rewards = [], []
        for step in range(steps):
            state, reward = self.model.fast_step(state, given[:, step])
            features.append(state.features.float())
            rewards.append(reward.float())
        decoded = torch.stack([features[step] for step in (range(steps) if shown is None else shown)], dim=1)
        pictures = self.model.decoder.picture(rearrange(decoded, "rollout step feature -> (rollout step) feature"))
        return Imagined(
            rearrange(pictures.cpu().numpy(), "(rollout step) ... -> rollout step ...", rollout=num),
            torch.stack(rewards, dim=1).cpu().numpy(),
            given.cpu().numpy(),
        )

    def _last_action(self) -> Tensor | None:
        """The action executed last, which the actor, noise or a replacement may have chosen, (batch, action).

        It is NaN at the first decision of an episode; None before any.
        """
        if self._action is None or self._is_reset is None:
            return self._action
        return self._action.masked_fill(self._is_reset[:, None], torch.nan)

    def _replace_actions(self, actions: np.ndarray) -> np.ndarray:
        """The actions (batch, action), in which rows that are not finite hold the row's last action, or zeros."""
        is_broken = ~np.isfinite(actions).all(axis=1)
        known = self._last_action()
        last = np.zeros_like(actions) if known is None else known.float().nan_to_num().cpu().numpy()
        if self.num_replaced_actions == 0:
            warnings.warn(
                "the agent's action is not finite: its last finite action, or zeros, is executed instead; its weights "
                "or its belief hold NaN or infinity",
                RuntimeWarning,
                stacklevel=3,
            )
        self.num_replaced_actions += int(is_broken.sum())
        return np.where(is_broken[:, None], last, actions).astype(np.float32)

    def _explore(self, action: Tensor, noise: Tensor) -> Tensor:
        """The action with standard normal noise, (batch, action) each; see `noise_std`."""
        moved = (action + self.noise_std * noise).clamp(-1.0, 1.0)
        if isinstance(self.model.actor, MixedActor):
            places = self.model.actor.code.discrete
            quantile, share = torch.special.ndtr(noise[:, places]), min(self.noise_std, 1.0)
            drawn = (2.0 * quantile / share - 1.0).clamp(-1.0, 1.0)  # uniform where the quantile is below the share
            moved[:, places] = torch.where(quantile < share, drawn, action[:, places]).to(moved.dtype)
        return moved

    def _choose(self, state: State) -> Tensor:
        """The action for a belief, in [-1, 1], (batch, action)."""
        raise AssertionError("a subclass of ModelAgent defines _choose")

    def _build_goals(
        self, objective: str | Expression | Term | None, constraints: str | Sequence[Constraint], planner: Planner
    ) -> tuple[Term | None, Sequence[Constraint]]:
        """The planner's objective and constraints, see `build_goals`."""
        return build_goals(
            objective,
            constraints,
            model=self.model,
            env=self.config.env,
            planner=planner,
            encode_goal=self._encode_goal,
        )

    def _encode_goal(self, path: str) -> Tensor:
        """The latents of an image file, one for each quarter turn of the image, (turn, latent)."""
        if self.model.spaces.cameras > 1 or self.model.spaces.vector_dim:
            raise UserError("a goal image shows one camera, and this agent sees more: name quantities instead")
        image = read_goal_image(path, self.model.spaces.frame_size)
        return self._encode_frames(turned(self._check_frames(image[None]), self._turns))

    def _check_seen(self, seen: Seen, single: bool) -> Tensor | Observation:
        """What the encoder reads, (batch, ...), on the model's device.

        Raises:
            ValueError: Frames or vectors have another shape or dtype, or are missing.
        """
        frame, size = frame_of(seen), self.model.spaces.vector_dim
        frames = self._check_frames(frame[None] if single else frame)
        if not size and not isinstance(seen, tuple):
            return frames
        vectors = np.asarray(seen[1], np.float32) if isinstance(seen, tuple) else np.zeros((0, 0), np.float32)
        vectors = vectors[None] if single and vectors.ndim == 1 else vectors
        if not size or vectors.shape != (len(frames), size):
            wanted = f'act((frame, info["vectors"])) with {size} numbers' if size else "act(frame) without vectors"
            raise ValueError(f"this agent takes {wanted}, got vectors of shape {vectors.shape}")
        return Observation(
            frames, torch.from_numpy(np.require(vectors, requirements=("C", "W"))).to(self.generator.device)
        )

    def _encode_frames(self, frames: Tensor | Observation) -> Tensor:
        """Latents of frames (batch, 64, 64, 3) at the first moment of an episode, (batch, latent)."""
        return self.model.see(self.model.dynamics.initial(len(frames)).deter, frames).stoch

    def _update_belief(self, frames: Tensor | Observation) -> State:
        """The belief after new frames (batch, 64, 64, 3), from the last belief and the action executed since.

        Raises:
            ValueError: The batch changed without a reset.
        """
        if self.state is not None and len(self.state.deter) != len(frames):
            raise ValueError(f"got {len(frames)} frames after {len(self.state.deter)}: call reset() between batches")
        turns = self._turns
        if not isinstance(frames, Observation):
            frames = turned(frames, turns)
        if self.state is None or self._action is None:
            return folded(self._infer(self.model.dynamics.initial(len(frames)), None, frames, None), turns)
        is_first = None if self._is_reset is None else per_turn(self._is_reset, turns)
        return folded(self._infer(flat(self.state), per_turn(self._action, turns), frames, is_first), turns)

    def _infer(
        self, state: State, action: Tensor | None, frames: Tensor | Observation, is_first: Tensor | None
    ) -> State:
        """The belief of `FrameFunctions.infer`; subclasses read more from the same call."""
        return self._frame_functions.infer(state, action, frames, is_first)

    def _act_by_actor(self, state: State) -> Tensor:
        """The mode of the actor, mean over turns, in [-1, 1], (batch, action)."""
        mean, _ = self._frame_functions.act(flat(state))
        return mean_over_turns(mean, state)

    def _check_frames(self, frames: np.ndarray) -> Tensor:
        """The frames (batch, 64, 64, 3) on the model's device.

        Raises:
            ValueError: The frames have another shape or dtype.
        """
        shape = self.model.spaces.frame_shape
        if not isinstance(frames, np.ndarray):
            raise ValueError(f"frames must be a NumPy array, got {type(frames).__name__}")
        if frames.dtype != np.uint8 or frames.shape[1:] != shape:
            raise ValueError(f"frames must be uint8 {shape}, got {frames.dtype} {frames.shape[1:]}")
        return torch.from_numpy(np.require(frames, requirements=("C", "W"))).to(self.generator.device)


def copy_tensor(value: Tensor | None) -> Tensor | None:
    """A copy of a tensor on the CPU; None for None."""
    return None if value is None else value.detach().cpu().clone()


class CorrelatedNoise:
    """Standard normal noise, correlated with the noise of the previous decision (an AR(1) process).

    White noise hardly moves a heavy body, because pushes of successive decisions cancel each other.

    Attributes:
        last: The latest noise, (batch, action); None before the first.

    Args:
        correlation: Correlation between one decision and the next, in [0, 1).
    """

    def __init__(self, correlation: float) -> None:
        self.correlation = correlation
        self.last: Tensor | None = None

    def draw(self, like: Tensor, generator: torch.Generator, is_new: Tensor | None = None) -> Tensor:
        """The next noise, of the shape of an action (batch, action).

        Args:
            like: An action, (batch, action), for shape and device.
            generator: Random stream of the noise.
            is_new: Environments whose episode begins, (batch,) bool: their noise is independent of the past. None
                stands for no environment.
        """
        white = torch.randn(like.shape, generator=generator, device=like.device, dtype=torch.float32)
        noise = white
        if self.last is not None and self.correlation > 0.0:
            noise = self.correlation * self.last + (1.0 - self.correlation**2) ** 0.5 * white
            noise = noise if is_new is None else torch.where(is_new[:, None], white, noise)
        self.last = noise
        return noise

    def reset(self) -> None:
        """Forgets the latest noise of all environments."""
        self.last = None
