"""`benchmark.py soak --checkpoint DIR`: deadlines that agents miss on the wall clock.

Agents take turns on recorded frames with an idle agent, which misses deadlines only because of the machine. The table
shows missed deadlines per 10,000 decisions; decision times and wake-up delays are in milliseconds.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.report import format_number, format_table, write_json
from latentplan.commands.shell import ComputeRequest
from latentplan.config.checks import above_zero, at_least
from latentplan.config.parsing import option, require_known

if TYPE_CHECKING:
    from latentplan.agents.base import Agent, Seen

MODES = ("actor", "gated", "background", "planner")
IDLE = "no-op"
NUM_FRAMES = 250
WARM_UP_DECISIONS = 5
DEADLINE_SHARE = 0.3  # share of a period for a search; encoding and gating take about as much
PAUSE_SECONDS = 0.2  # between blocks, so that a search in the background does not disturb the next agent


@dataclass
class Tally:
    """Decisions and missed deadlines of one agent.

    Attributes:
        due: Number of period boundaries at which a decision was due.
        misses: Number of boundaries at which the agent was still busy with an earlier decision.
        decision_ms: Milliseconds of each decision, from a frame in memory to an action.
        wake_ms: Milliseconds from each boundary until the operating system woke the loop.
    """

    due: int = 0
    misses: int = 0
    decision_ms: list[float] = field(default_factory=list)
    wake_ms: list[float] = field(default_factory=list)


class IdleAgent:
    """Does nothing; misses deadlines only because of the machine."""

    def act(self, frame: Seen) -> None:
        """Does nothing."""

    def reset(self) -> None:
        """Does nothing."""


@dataclass(frozen=True, kw_only=True)
class Request(ComputeRequest):
    """Flags of `benchmark.py soak`.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        mode: Modes of the agent, among actor, gated, background and planner; an idle agent takes part too.
        control_hz: Decisions per second.
        decisions: Decisions that are due, of each agent.
        block: Decisions of one agent before the next agent takes over.
        json: Result as JSON.
    """

    checkpoint: Path = option(metavar="DIR")
    mode: tuple[str, ...] = option(("actor", "gated", "background"), separator=",")
    control_hz: float = 50.0
    decisions: int = 10_000
    block: int = 250
    json: Path | None = option(None, metavar="FILE", is_output=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        above_zero(self, "control_hz")
        at_least(self, decisions=1, block=1)
        require_known("mode", self.mode, MODES)


def run(request: Request) -> int:
    """Lets the agents take turns in real time, and counts the deadlines that each agent misses."""
    modes, control_hz, checkpoint = request.mode, request.control_hz, str(request.checkpoint)
    decisions, block = request.decisions, request.block
    device = request.use_device()
    import torch

    from bench.machine import describe_machine

    about = {
        "checkpoint": checkpoint,
        "control_hz": control_hz,
        "block": block,
        "machine": describe_machine(torch.device(device)),
    }
    frames = _record_frames(request.checkpoint, device)
    seconds = decisions / control_hz * (len(modes) + 1)
    print(f"{', '.join([IDLE, *modes])} at {control_hz:g} Hz in turns, {seconds:.0f} s in all", flush=True)
    tallies = {name: Tally() for name in (IDLE, *modes)}
    code = 0
    from latentplan.planning import settle

    with _load_agents(checkpoint, modes, device, 1000.0 * DEADLINE_SHARE / control_hz) as agents:
        settle()
        try:
            take_turns(agents, frames, control_hz, decisions, block, tallies)
        except KeyboardInterrupt:
            code = 130
            print("\ninterrupted", flush=True)
    rows = soak_rows(tallies)
    print(soak_table(rows))
    write_json(request.json, {**about, "agents": rows})
    return code


def take_turns(
    agents: Mapping[str, Any],
    frames: Sequence[Seen],
    control_hz: float,
    decisions: int,
    block: int,
    tallies: Mapping[str, Tally],
) -> None:
    """Plays blocks of every agent in turn, so that noise of the machine affects all agents.

    Args:
        agents: Agents by name.
        frames: What agents see, as `Agent.act` takes it, repeated in a cycle.
        control_hz: Decisions per second.
        decisions: Number of due decisions of each agent.
        block: Number of due decisions of one agent before the next agent takes over.
        tallies: Tallies by name, which are updated.
    """
    for first in range(0, decisions, block):
        for name, agent in agents.items():
            agent.reset()
            for frame in frames[:WARM_UP_DECISIONS]:
                agent.act(frame)
            play_block(agent, frames, control_hz, min(block, decisions - first), tallies[name])
            time.sleep(PAUSE_SECONDS)


def play_block(agent: Agent | IdleAgent, frames: Sequence[Seen], control_hz: float, due: int, tally: Tally) -> None:
    """Decides at the period boundaries of the wall clock; a boundary is missed if the agent is still busy."""
    period = 1.0 / control_hz
    began = time.perf_counter() + period
    boundary = 0
    while boundary < due:
        time.sleep(max(0.0, began + boundary * period - time.perf_counter()))
        woken = time.perf_counter()
        agent.act(frames[boundary % len(frames)])
        finished = time.perf_counter()
        following = min(max(boundary + 1, math.ceil((finished - began) * control_hz)), due)
        tally.misses += following - boundary - 1
        tally.wake_ms.append(1000.0 * (woken - began - boundary * period))
        tally.decision_ms.append(1000.0 * (finished - woken))
        tally.due += following - boundary
        boundary = following


def soak_rows(tallies: Mapping[str, Tally]) -> dict[str, dict[str, Any]]:
    """Decisions and misses of each agent, as plain values; agents without a turn are left out."""
    import numpy as np

    from latentplan.evaluation.statistics import latency_percentiles

    played = {name: tally for name, tally in tallies.items() if tally.due}
    idle = played[IDLE].misses / played[IDLE].due if IDLE in played else math.nan
    return {
        name: {
            "decisions_due": tally.due,
            "deadline_misses": tally.misses,
            "misses_per_10000": 1e4 * tally.misses / tally.due,
            "minus_no_op": 1e4 * (tally.misses / tally.due - idle),
            "decision_ms": {
                **latency_percentiles(np.asarray(tally.decision_ms)),
                "max": max(tally.decision_ms),
            },
            "wake_ms": {**latency_percentiles(np.asarray(tally.wake_ms)), "max": max(tally.wake_ms)},
        }
        for name, tally in played.items()
    }


def soak_table(rows: Mapping[str, dict[str, Any]]) -> str:
    """The agents as a text table."""
    header = ["agent", "due", "missed", "per 10,000", "minus no-op", "ms p50", "p99", "max", "wake p99"]
    lines = [
        [
            name,
            f"{row['decisions_due']:,}",
            f"{row['deadline_misses']:,}",
            format_number(row["misses_per_10000"]),
            "-" if name == IDLE else format_number(row["minus_no_op"], sign=True),
            *(format_number(row["decision_ms"][key], 2) for key in ("p50", "p99", "max")),
            format_number(row["wake_ms"]["p99"], 2),
        ]
        for name, row in rows.items()
    ]
    return format_table(header, lines)


def _record_frames(checkpoint: Path, device: str) -> list[Seen]:
    """What the actor sees in an episode: frames uint8 (height, width, 3 * camera), with vectors where it sees some."""
    from latentplan.agents.checkpoint import load_agent, load_model
    from latentplan.envs import make_env
    from latentplan.evaluation.episodes import see

    _, config, _ = load_model(checkpoint)
    agent = load_agent(checkpoint, mode="actor", device=device)
    env = make_env(config.env)
    try:
        frames, over = [see(*env.reset(seed=0))], False
        while len(frames) < NUM_FRAMES and not over:
            frame, _, terminated, truncated, info = env.step(agent.act(frames[-1]))
            frames.append(see(frame, info))
            over = terminated or truncated
        return frames
    finally:
        env.close()


@contextlib.contextmanager
def _load_agents(checkpoint: str, modes: Sequence[str], device: str, deadline_ms: float) -> Any:
    """The agents by name, ready to act; agents that search before they act have a deadline."""
    from latentplan.agents.background import BackgroundAgent
    from latentplan.agents.checkpoint import load_agent

    with contextlib.ExitStack() as stack:
        agents: dict[str, Any] = {IDLE: IdleAgent()}
        for mode in modes:
            settings = {"deadline_ms": deadline_ms} if mode in ("gated", "planner") else {}
            agent: Any = load_agent(checkpoint, mode=mode, device=device, **settings)
            if isinstance(agent, BackgroundAgent):
                stack.enter_context(agent).wait_until_ready()
            agents[mode] = agent
        yield agents
