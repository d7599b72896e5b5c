"""One frame seen from four sides: for a body to which every side is the same, four beliefs of one world.

What a network mistakes it mistakes in one picture; turned by a quarter the same place is another picture, with another
mistake. An agent that keeps a belief of each turn, and acts by what all of them say, is misled by the rare mistake that
most of them share (averaging a network over symmetries: Silver et al. 2017, "Mastering the game of Go without human
knowledge", methods).

A belief then has leaves (batch, turn, size), the frame as it is first. Functions here take beliefs of either kind.
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
    """Frames (batch, side, side, channel) and their quarter turns, batch-major: (batch turn, side, side, channel)."""
    if turns == 1:
        return frames
    return torch.stack([torch.rot90(frames, quarter, (1, 2)) for quarter in range(turns)], 1).flatten(0, 1)


def folded(state: State, turns: int) -> State:
    """The belief (batch, turn, size) whose rows are (batch turn, size); as it is where there is one turn."""
    return state if turns == 1 else State(*(part.unflatten(0, (-1, turns)) for part in state))


def flat(state: State) -> State:
    """The rows (batch turn, size) of a belief."""
    return state if state.deter.ndim == 2 else State(*(part.flatten(0, 1) for part in state))


def per_turn(values: Tensor, turns: int) -> Tensor:
    """What holds for each environment, (batch, ...), for the rows of its belief, (batch turn, ...)."""
    return values if turns == 1 else values.repeat_interleave(turns, 0)


def unturned(state: State) -> State:
    """The belief (batch, size) of the frames as they are."""
    return state if state.deter.ndim == 2 else State(*(part[:, 0] for part in state))


def mean_over_turns(values: Tensor, state: State) -> Tensor:
    """The mean (batch, ...) of what is told for the rows (batch turn, ...) of a belief."""
    return values if state.deter.ndim == 2 else values.unflatten(0, (len(state.deter), -1)).mean(1)


class TurnedModel:
    """A world model as planners see it whose states are beliefs of all four turns.

    A candidate is judged in each of them, as one judges it over particles. Rows (rows, size), as rollouts have them, go
    to the model itself, and so does all that is not defined here.

    Args:
        model: What imagines one turn.

    Attributes:
        num_particles: Turns, in which every candidate is judged.
    """

    num_particles = QUARTERS

    def __init__(self, model: Any) -> None:
        self.model = model

    def __getattr__(self, name: str) -> Any:
        if name == "model":  # not yet there, while this is unpickled
            raise AttributeError(name)
        return getattr(self.model, name)

    def shown_as(self, view: Callable[[Any], Any]) -> TurnedModel:
        """The same turns of another view of the model; see `latentplan.planning.objectives.conditioned`."""
        return TurnedModel(view(self.model))

    def particles(self, state: State, num: int) -> State:
        """Rows (batch num, size): the turns of each belief in order, over again where there are fewer than `num`."""
        order = torch.arange(num, device=state.deter.device) % QUARTERS
        return State(*(part[:, order].flatten(0, 1) for part in state))

    def step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """The next belief, and the mean of what its turns predict as reward, (batch,)."""
        return self._imagine(self.model.step, state, action)

    def fast_step(self, state: State, action: Tensor) -> tuple[State, Tensor]:
        """`step`, compiled where that can be, without gradients."""
        return self._imagine(self.model.fast_step, state, action)

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, State]:
        """The turns' mean rewards (batch, horizon) of sequences (batch, horizon, action), and the last belief."""
        last, rewards = self._imagine(lambda *what: self.model.rollout(*what)[::-1], state, actions)
        return rewards, last

    def value(self, state: State) -> Tensor:
        """The mean of the turns' values, (batch,)."""
        return mean_over_turns(self.model.value(flat(state)), state)

    def continues(self, state: State) -> Tensor:
        """The mean of the turns' probabilities of going on, (batch,)."""
        return mean_over_turns(self.model.continues(flat(state)), state)

    def surprise(self, state: State) -> Tensor:
        """The mean of the turns' surprise, in nats, (batch,)."""
        return mean_over_turns(self.model.surprise(flat(state)), state)

    def policy(self, state: State, generator: torch.Generator | None = None) -> Tensor:
        """The mean of the turns' actions, (batch, action): samples with a generator, modes without."""
        return mean_over_turns(self.model.policy(flat(state), generator), state)

    def propose(self, state: State, num: int, horizon: int, generators: Sequence[torch.Generator]) -> Tensor:
        """The mode of `policy`, then what the actor does from single turns, each in turn: its modes, then samples.

        Args:
            state: Beliefs (batch, turn, size).
            num: Sequences from each.
            horizon: Model steps.
            generators: One stream per belief.

        Returns:
            Sequences (batch num, horizon, action).
        """
        each = -(-(num - 1) // QUARTERS)
        proposals = self._follow(state, horizon).unsqueeze(1)
        if each:
            streams = [generator for generator in generators for _ in range(QUARTERS)]
            rows = self.model.propose(flat(state), each, horizon, streams)
            pattern = "(batch turn each) time action -> batch (each turn) time action"
            by_turn = rearrange(rows, pattern, turn=QUARTERS, each=each)
            proposals = torch.cat([proposals.to(rows.dtype), by_turn], 1)
        return proposals[:, :num].flatten(0, 1)

    def _follow(self, state: State, horizon: int) -> Tensor:
        """The mode of `policy` and of what follows from it, (batch, horizon, action)."""
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
