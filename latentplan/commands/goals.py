"""`latentplan goals`: teach a trained agent to pursue goals that are named later."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from latentplan.commands.flags import overrides
from latentplan.commands.shell import LearningRequest, name_folder
from latentplan.config import GoalsConfig
from latentplan.config.run_folder import GOALS, require_saves


@dataclass(frozen=True, kw_only=True)
class Request(LearningRequest):
    """The command line of goal-conditioned learning.

    Attributes:
        settings: Settings of the learning that were given.
    """

    RESUMABLE = ("--updates", "--minutes", "--device", "--threads")
    NOTES = (
        "All other weights of the agent stay as they are. The agent learns from the replay of its run where "
        "--checkpoint names a run; a checkpoint without a run first plays --play-decisions decisions."
    )

    settings: dict[str, Any] = overrides(GoalsConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        GoalsConfig(**self.settings)


def resolve(request: Request) -> dict[str, Any]:
    """The fields of the request, with every setting of the learning.

    Raises:
        UserError: The agent cannot be read, or there is nothing to resume.
    """
    if request.resume is not None:
        require_saves(request.resume, GOALS)  # before torch is imported
        from latentplan.training.goal_conditioning.run import read_resumed

        return {**vars(request), "settings": read_resumed(request.resume, **request.settings)[1]}
    from latentplan.agents.info import read_info

    assert request.checkpoint is not None
    read_info(request.checkpoint)
    return {**vars(request), "settings": GoalsConfig(**request.settings)}


def run(request: Request) -> int:
    """Learn goals, or continue to learn them, and return the exit code."""
    from latentplan.agents.info import read_info

    info = {} if request.checkpoint is None else read_info(request.checkpoint)
    if request.resume is not None:  # before torch is imported
        require_saves(request.resume, GOALS)
    device = request.use_device()
    from latentplan.training import learn_goals, resume_goals

    if request.resume is not None:
        return resume_goals(request.resume, device=device, **request.settings).exit_code
    assert request.checkpoint is not None
    out = request.out or name_folder("goals", info)
    return learn_goals(request.checkpoint, out, GoalsConfig(**request.settings), device=device).exit_code
