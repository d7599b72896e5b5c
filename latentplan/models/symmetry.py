"""Beliefs about a frame and its three quarter turns, for tasks that are the same when the picture is rotated.

The network's errors differ between a picture and its quarter turns. An agent that keeps one belief per turn and acts on
the mean of the turns is misled only by errors that most turns share (averaging a network over symmetries: Silver et al.
2017, "Mastering the game of Go without human knowledge", methods).

A turned belief has leaves (batch, turn, size), with the unrotated frame first. An ordinary belief has leaves
(batch, size). The functions of this module take both kinds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from einops import rearrange
from torch import Tensor

from latentplan.models.dynamics import State

QUARTERS = 4


def turned(frames: Tensor, turns: int = QUARTERS) -> Tensor:
    """Frames (batch, side, side, channel) and their quarter turns, batch-major, (batch turn, side, side, channel)."""
    if turns == 1:
        return frames
    return torch.stack([torch.rot90(frames, quarter, (1, 2)) for quarter in range(turns)], 1).flatten(0, 1)


def folded(state: State, turns: int) -> State:
    """The belief (batch, turn, size) of rows (batch turn, size); the rows themselves if there is one turn."""
    return state if turns == 1 else State(*(part.unflatten(0, (-1, turns)) for part in state))


def flat(state: State) -> State:
    """The rows (batch turn, size) of a belief (batch, turn, size)."""
    return state if state.deter.ndim == 2 else State(*(part.flatten(0, 1) for part in state))


def per_turn(values: Tensor, turns: int) -> Tensor:
    """Values of environments, (batch, ...), repeated for the rows of their beliefs, (batch turn, ...)."""
    return values if turns == 1 else values.repeat_interleave(turns, 0)


def first_turn(state: State) -> State:
    """The belief (batch, size) of the unrotated frames."""
    return state if state.deter.ndim == 2 else State(*(part[:, 0] for part in state))


def mean_over_turns(values: Tensor, state: State) -> Tensor:
    """The mean over turns, (batch, ...), of values of a belief's rows, (batch turn, ...)."""
    return values if state.deter.ndim == 2 else values.unflatten(0, (len(state.deter), -1)).mean(1)


class TurnedModel:
    """A model for planners whose states are beliefs about all four turns, around a world model of one turn.

    A planner scores every candidate in each turn, because the turns are particles. Calls with ordinary states
    (rows, size) and accesses to all other attributes go to the world model.

    Args:
        model: The world model of a single turn.

    Attributes:
        num_particles: The number of turns in which every candidate is scored.
    """

    num_particles = QUARTERS

    def __init__(self, model: Any) -> None:
        self.model = model

    def __getattr__(self, name: str) -> Any:
        if name == "model":  # unpickling reads attributes before `model` is set
            raise AttributeError(name)
        return getattr(self.model, name)

    def shown_as(self, view: Callable[[Any], Any]) -> TurnedModel:
        """The turned model of a view of the model; see `latentplan.planning.objectives.conditioned`."""
        return TurnedModel(view(self.model))

    def particles(self, state: State, num: int) -> State:
        """Rows (batch num, size): the turns of each belief in order, repeated if there are fewer than `num`."""
        order = torch.arange(num, device=state.deter.device) % QUARTERS
        return State(*(part[:, order].flatten(0, 1) for part in state))

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The next belief, and the mean over turns of the predicted reward, (batch,)."""
        return self._imagine(self.model.step, state, action)

    def fast_step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The same as `step` up to rounding, faster and without gradients; see `WorldModel.fast_step`."""
        return self._imagine(self.model.fast_step, state, action)

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """Rewards (batch, horizon) along sequences (batch, horizon, action), means over turns, and the last belief."""
        last, rewards = self._imagine(lambda *arguments: self.model.rollout(*arguments)[::-1], state, actions)
        return rewards, last

    def value(self, state: State) -> Tensor:
        """The value, mean over turns, (batch,)."""
        return mean_over_turns(self.model.value(flat(state)), state)

    def continues(self, state: State) -> Tensor:
        """The probability that the episode continues, mean over turns, (batch,)."""
        return mean_over_turns(self.model.continues(flat(state)), state)

    def policy(self, state: State, generator: torch.Generator | None = None) -> Tensor:
        """The action (batch, action), mean over turns: of samples with a generator, of modes without."""
        return mean_over_turns(self.model.policy(flat(state), generator), state)

    def propose(self, state: State, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """The mode of `policy` first, then for each turn the actor's mode and samples from that turn alone.

        Args:
            state: Beliefs (batch, turn, size).
            num: Sequences per belief.
            horizon: Model steps.
            generators: One random stream per belief.

        Returns:
            Sequences (batch num, horizon, action).
        """
        each = -(-(num - 1) // QUARTERS)
        proposals = self._mode_rollout(state, horizon).unsqueeze(1)
        if each:
            streams = [generator for generator in generators for _ in range(QUARTERS)]
            rows = self.model.propose(flat(state), each, horizon, streams)
            pattern = "(batch turn each) time action -> batch (each turn) time action"
            by_turn = rearrange(rows, pattern, turn=QUARTERS, each=each)
            proposals = torch.cat([proposals.to(rows.dtype), by_turn], 1)
        return proposals[:, :num].flatten(0, 1)

    def _mode_rollout(self, state: State, horizon: int) -> Tensor:
        """The actions of the mode of `policy`, step after step, (batch, horizon, action)."""
        actions: list[Tensor] = []
        for _ in range(horizon):
            actions.append(self.policy(state))
            state, _ = self.fast_step(state, actions[-1])
        return torch.stack(actions, 1)

    @staticmethod
    def _imagine(
        function: Callable[[State, Tensor], tuple[State, Tensor]], state: State, actions: Tensor
    ) -> tuple[State, Tensor]:
        if state.deter.ndim == 2:
            return function(state, actions)
        following, rewards = function(flat(state), per_turn(actions, QUARTERS))
        return folded(following, QUARTERS), mean_over_turns(rewards, state)
