"""`benchmark.py decide`: milliseconds per decision of planner, actor and exported actor, from a frame in memory.

The table shows percentiles over decisions on random frames, and the model steps per decision and environment.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from bench.options import ComposeRequest
from bench.report import format_number, format_table, write_json
from latentplan.commands.flags import overrides
from latentplan.config import Config, PlannerConfig, UserError, to_dict
from latentplan.config.checks import at_least
from latentplan.config.files import build_config
from latentplan.config.parsing import option

if TYPE_CHECKING:
    import numpy as np
    import torch

    from latentplan.agents.actor import ActorAgent
    from latentplan.agents.base import Agent
    from latentplan.models import WorldModel

WARM_UP_DECISIONS = 3
UNTRAINED_DISCOUNT = 0.99


@dataclass(frozen=True, kw_only=True)
class Request(ComposeRequest):
    """Flags of `benchmark.py decide`.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run; None times an untrained agent.
        batch: Environments of each decision.
        decisions: Decisions that are timed.
        json: Result as JSON.
        planner: Settings of the search.
    """

    checkpoint: Path | None = option(None, metavar="DIR")
    batch: int = 1
    decisions: int = 50
    json: Path | None = option(None, metavar="FILE", is_output=True)
    planner: dict[str, Any] = overrides(PlannerConfig, prefix="planner.")

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, batch=1, decisions=1)
        for name in ("domain", "preset", "action_dim"):
            if self.checkpoint is not None and getattr(self, name) is not None:
                raise UserError(f"--{name.replace('_', '-')} has no effect with --checkpoint; give one of the two")


def run(request: Request) -> int:
    """Times decisions on random frames and prints the percentiles."""
    batch, decisions = request.batch, request.decisions
    composed = None if request.checkpoint is not None else request.compose({"planner": request.planner})
    device_name = request.use_device()
    import torch

    from bench.machine import describe_machine

    device = torch.device(device_name)
    model, config, discount = _load_model(request, composed, device)
    if model.spaces.vector_dim:
        raise UserError(f"decide shows random pictures alone, and {request.checkpoint} was trained with env.vectors")
    arms = {
        name: measure_decisions(agent, batch, decisions) for name, agent in _agents(model, config, discount).items()
    }
    rows = [
        [
            name,
            *(format_number(facts["decision_ms"][key], 2) for key in ("p50", "p95", "p99")),
            f"{facts['model_steps']:,}",
        ]
        for name, facts in arms.items()
    ]
    machine = describe_machine(device)
    print(f"{config.env.domain} on {machine['name']} ({device.type}, {machine['threads']} threads), batch {batch}")
    print(format_table(["decides", "ms p50", "p95", "p99", "model steps per decision"], rows))
    about = {"domain": config.env.domain, "batch": batch, "decisions": decisions, "machine": machine}
    write_json(request.json, {**about, "planner": to_dict(config.planner), "arms": arms})
    return 0


def measure_decisions(agent: Agent, batch: int, decisions: int) -> dict[str, Any]:
    """Milliseconds from frames in memory to actions, and model steps per decision and environment.

    Args:
        agent: The agent; the plans of a planning agent are warm-started.
        batch: Frames per decision; a single frame has no batch axis.
        decisions: Number of timed decisions.

    Returns:
        `decision_ms` with `p50`, `p95` and `p99`, and `model_steps`.
    """
    import numpy as np

    from latentplan.evaluation.statistics import latency_percentiles

    shape: tuple[int, ...] = agent.model.spaces.frame_shape  # type: ignore[attr-defined]
    shape = shape if batch == 1 else (batch, *shape)
    rng, milliseconds = np.random.default_rng(0), []
    agent.reset()
    for index in range(WARM_UP_DECISIONS + decisions):
        frames = rng.integers(0, 256, shape, dtype=np.uint8)
        started = time.perf_counter()
        agent.act(frames)
        if index >= WARM_UP_DECISIONS:
            milliseconds.append(1000.0 * (time.perf_counter() - started))
    with count_model_steps(agent.model) as counts:  # type: ignore[attr-defined]
        agent.act(frames)
    return {"decision_ms": latency_percentiles(np.asarray(milliseconds)), "model_steps": counts["rows"] // batch}


@contextmanager
def count_model_steps(model: WorldModel) -> Iterator[dict[str, int]]:
    """Counts the model steps of all rows, those of proposals too, under `rows`, inside the `with` block."""
    counts = {"rows": 0}

    def counting(method: Any) -> Any:
        def call(state: Any, actions: torch.Tensor) -> Any:
            counts["rows"] += math.prod(actions.shape[:-1])
            return method(state, actions)

        return call

    def propose(own: WorldModel, state: Any, noise: torch.Tensor) -> torch.Tensor:
        counts["rows"] += math.prod(noise.shape[:-1])
        proposals: torch.Tensor = imagine(own, state, noise)
        return proposals

    names, backend = ("step", "fast_step", "rollout"), model.backend
    imagine = backend.propose
    for name in names:
        setattr(model, name, counting(getattr(model, name)))
    backend.propose = propose  # type: ignore[method-assign,assignment]
    try:
        yield counts
    finally:
        for name in names:
            delattr(model, name)
        del backend.propose


class ExportedActor:
    """The program that `latentplan export` writes, as an agent.

    Args:
        agent: The agent that is exported.
    """

    def __init__(self, agent: ActorAgent) -> None:
        import torch

        from latentplan.agents.export import export_actor, input_sizes

        self.model, self._sizes = agent.model, input_sizes(agent.model)
        with tempfile.TemporaryDirectory() as folder:
            self._program = torch.export.load(export_actor(agent, Path(folder) / "actor.pt2")).module()
        self._past: tuple[torch.Tensor, ...] | None = None

    def act(self, frame: Any) -> np.ndarray:
        """The action for frames uint8 (height, width, 3 * camera), or (batch, ...) of them."""
        import torch

        frames = torch.from_numpy(frame).view(-1, *frame.shape[-3:])
        past = self._past or tuple(torch.zeros(len(frames), size) for size in self._sizes.values())
        is_first = torch.full((len(frames),), self._past is None)
        with torch.inference_mode():
            action, deter, stoch = self._program(frames, *past, is_first)
        self._past = deter, stoch, action
        actions: np.ndarray = action.numpy()
        return actions[0] if frame.ndim == 3 else actions

    def reset(self) -> None:
        """Forgets the past."""
        self._past = None

    def seed(self, seed: int) -> None:
        """Does nothing, because the program draws no random numbers."""


def _load_model(request: Request, composed: Config | None, device: torch.device) -> tuple[WorldModel, Config, float]:
    """The model, settings and discount of the checkpoint, or of an untrained agent with composed settings."""
    if composed is not None:
        import torch

        from latentplan.models import WorldModel
        from latentplan.models.fast import accelerate

        torch.manual_seed(0)
        model = accelerate(WorldModel(composed.model, request.action_size(composed)).to(device))
        return model, composed, UNTRAINED_DISCOUNT
    from latentplan.agents.checkpoint import load_model

    assert request.checkpoint is not None
    model, config, info = load_model(request.checkpoint, str(device))
    layer = {"planner": {**to_dict(config.planner), **request.planner}}
    return model, replace(config, planner=build_config(layer).planner), float(info["discount"])


def _agents(model: WorldModel, config: Config, discount: float) -> dict[str, Agent]:
    from bench.ablation_arms import without_actor
    from latentplan.agents.actor import ActorAgent
    from latentplan.agents.planning import PlanningAgent
    from latentplan.models import Rssm

    alone = replace(config.planner, **without_actor(config.planner))
    actor = ActorAgent(model, config)
    agents: dict[str, Agent] = {
        "planner": PlanningAgent(model, config, discount),
        "planner without actor": PlanningAgent(model, config, discount, planner=alone),
        "actor": actor,
    }
    # The program computes on a processor, and can be written for the dynamics of the class Rssm alone.
    if model.device.type == "cpu" and type(model.dynamics) is Rssm:
        agents["exported actor"] = cast("Agent", ExportedActor(actor))
    return agents
