"""Whether an agent can play in an environment: the same form of actions, frames and vectors."""

from __future__ import annotations

from typing import Any

from latentplan.config import UserError
from latentplan.config.spaces import Spaces
from latentplan.envs.vector import read_own_facts


def refuse_other_spaces(env: Any, name: str, action_dim: int, spaces: Spaces) -> None:
    """Refuses an environment whose actions or observations have another form than those of an agent.

    Args:
        env: The environment, from `make_env`, `make_guarded_env` or `wrap_user_env`.
        name: Name of the environment, for the error.
        action_dim: Numbers of the agent's actions.
        spaces: What the agent knows of its actions and observations.

    Raises:
        UserError: Something differs; one line names it.
    """
    facts = read_own_facts(env)
    size = (facts["action_space"].shape or (0,))[0]
    shown: Spaces = facts["spaces"] or Spaces()
    differences = []
    if size != action_dim:
        differences.append(f"takes actions of {size} numbers, the agent gives {action_dim}")
    elif shown.choices != spaces.choices:
        differences.append(
            f"takes {_describe_choices(shown.choices)}, the agent gives {_describe_choices(spaces.choices)}"
        )
    for field, words in (
        ("cameras", "cameras"),
        ("frame_size", "pixels a side"),
        ("vector_dim", "numbers beside a frame"),
    ):
        theirs, own = getattr(shown, field), getattr(spaces, field)
        if theirs != own:
            differences.append(f"shows {theirs} {words}, the agent sees {own}")
    if differences:
        raise UserError(
            f"{name} {', and '.join(differences)}: give the environment that it learned in, with --env-id and "
            "--env-kwargs"
        )


def _describe_choices(choices: tuple[int, ...]) -> str:
    """The categories of each number of an action, 0 for a continuous number."""
    return f"actions of {', '.join(map(str, choices))} categories" if choices else "continuous actions"
