"""What a save holds of collection: the state of the collectors, and what they were asked for, as plain data.

Arrays are NumPy arrays while a run collects, and tensors in a save; see `to_tensors` and `to_arrays` of `episodes`.
"""

from __future__ import annotations

from typing import Any, Literal, TypedDict

from torch import Tensor


class OptionalEpisodeMemory(TypedDict, total=False):
    """What earlier versions did not save of a running episode.

    Attributes:
        is_short: Whether the episode is a short one.
        played: Decisions of the environment that belong to whole and to short episodes, int64 (2,).
    """

    is_short: bool
    played: Tensor


class EpisodeMemory(OptionalEpisodeMemory):
    """A running episode.

    Attributes:
        begun: Number of the episode in its environment, from 1.
        actions: Its actions so far, float32 (decision, action); none stand for an episode that is over.
        frame: CRC-32 checksum of its latest frame.
    """

    begun: int
    actions: Tensor
    frame: int


class OptionalAgentMemory(TypedDict, total=False):
    """What only agents that plan remember.

    Attributes:
        controller: The last plan.
    """

    controller: dict[str, Any]


class AgentMemory(OptionalAgentMemory):
    """What an agent knows of the running episodes; see `ModelAgent.memory`."""

    state: list[Tensor] | None
    action: Tensor | None
    is_reset: Tensor | None
    noise: Tensor | None


class CollectorMemory(TypedDict):
    """State of a collector after a round, from which `Collector.restore` continues.

    Attributes:
        agent: The agent that acted.
        belief: What this agent remembers; None of one without a model.
        episodes: The running episode of each environment.
        returns: Return so far of each, (env,).
        has_ended: Whether the episode is over, bool (env,).
        restarts: Environments that were made anew after a fault.
        has_seen_end: Whether an episode ended in a terminal state.
    """

    agent: Literal["planner", "actor", "goal", "random"]
    belief: AgentMemory | None
    episodes: list[EpisodeMemory]
    returns: Tensor
    has_ended: Tensor
    restarts: int
    has_seen_end: bool


class CrewMemory(TypedDict):
    """State of several collectors after a round.

    Attributes:
        members: State of each; None before its first share.
        ended: Workers of each number that ended and took their episodes with them.
        shares: Shares that each was asked for out of the order of rounds.
        restarts: As for one collector, over all of them.
        has_seen_end: As for one collector.
    """

    members: list[CollectorMemory | None]
    ended: list[int]
    shares: list[int]
    restarts: int
    has_seen_end: bool


Memory = CollectorMemory | CrewMemory | None


class Round(TypedDict):
    """Arguments of `Collector.collect`, without the weights."""

    behaviour: Literal["random", "planner", "actor"]
    decisions: int
    counter: int
    goal: str | None


class Clocks(TypedDict):
    """When an evaluation was asked for."""

    env_frames: int
    decisions: int
    updates: int
    minutes: float


class Evaluated(Clocks):
    """An evaluation: its clocks, and mean returns."""

    planner: float
    actor: float


class Requests(TypedDict):
    """What the worker was asked for and has not answered; see `Collect`."""

    collect: Round | None
    evaluate: Clocks | None
    weights: dict[str, Tensor] | None
