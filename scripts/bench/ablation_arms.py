"""Arms of an ablation: settings of the agent by name, and the episodes of each arm."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from latentplan.config import PlannerConfig, UserError, to_dict
from latentplan.config.files import build_config, field_names
from latentplan.config.parsing import raise_unknown
from latentplan.config.planner import override_planner

REFERENCE = "full"
NAMES = (REFERENCE, "no_actor", "no_value", "cold", "horizon1", "actor", "random")
DIFFERENT_ACTION = 0.1  # difference from which two actions in [-1, 1] count as different


class Arm(NamedTuple):
    """One configuration of the agent.

    Attributes:
        name: Name of the row in the table.
        mode: `planner`, `actor` or `random`.
        planner: Settings of the search that replace the settings of the checkpoint.
    """

    name: str
    mode: str
    planner: dict[str, Any]


class Outcome(NamedTuple):
    """Result of an arm.

    Attributes:
        arm: The arm.
        returns: Return of each episode.
        episode_ms: Median milliseconds per decision, for each episode.
        decision_ms: Percentiles `p50`, `p95` and `p99` over all decisions, in milliseconds.
        differs_from_actor: Share of the decisions at which the planner's action and the actor's mode for the same
            belief differ by more than 0.1 in some dimension; None for the modes actor and random.
    """

    arm: Arm
    returns: list[float]
    episode_ms: list[float]
    decision_ms: dict[str, float]
    differs_from_actor: float | None


def parse_arms(text: str, base: PlannerConfig) -> list[Arm]:
    """The arms of a text such as `full,actor,wide:init_std=1.0,num_iterations=6`; the reference always comes first.

    Args:
        text: Known names, and `name:field=value,field=value` for settings that replace settings of `base`.
        base: Settings of the search in the checkpoint.

    Raises:
        UserError: A name or field is unknown, a value is not allowed, or two arms have the same name.
    """
    given: dict[str, dict[str, str]] = {}  # settings of each arm, as typed
    for name, words in _split_arms(text):
        if name in given:
            raise UserError(f"two arms are named {name!r}; give each arm its own name")
        if not words and name not in NAMES:
            raise_unknown("arm", name, NAMES)
        if words and (not name or name in NAMES):
            raise UserError(f"arm {name!r} takes no settings; write newname:{words[0]}")
        given[name] = dict(_parse_setting(name, word) for word in words)
    names = [REFERENCE, *(name for name in given if name != REFERENCE)]
    return [_make_arm(name, given.get(name, {}), base) for name in names]


def without_actor(base: PlannerConfig) -> dict[str, Any]:
    """Settings of a search that does not use the actor."""
    tail = {"tail": "zero"} if base.tail == "policy" else {}
    surprise = {} if base.surprise_limit is None else {"surprise_limit": None}
    return {"num_policy_samples": 0, **tail, **surprise}


def play_arm(arm: Arm, checkpoint: str, seeds: Sequence[int], device: str, threads: int = 1) -> Outcome:
    """Plays one episode per seed, with the render quality of the checkpoint.

    Args:
        arm: The arm that plays.
        checkpoint: Folder of a checkpoint or of a run.
        seeds: Seeds of the starts.
        device: `cpu` or `cuda`.
        threads: CPU threads.
    """
    import numpy as np
    import torch

    from latentplan.agents.checkpoint import load_agent, load_model
    from latentplan.envs import make_env
    from latentplan.evaluation.episodes import Step, run_episodes
    from latentplan.evaluation.statistics import latency_percentiles

    torch.set_num_threads(threads)
    _, config, _ = load_model(checkpoint)
    agent: Any = load_agent(checkpoint, mode=arm.mode, device=device, **arm.planner)
    differs: list[bool] = []

    @torch.no_grad()
    def compare(step: Step) -> None:
        if step.action is not None:
            mode = agent.imagined.policy(agent.state)[0].float().cpu().numpy()
            differs.append(bool((np.abs(mode - step.action) > DIFFERENT_ACTION).any()))

    env = make_env(config.env)
    try:
        episodes = run_episodes(env, agent, seeds, on_step=compare if arm.mode == "planner" else None)
    finally:
        env.close()
    return Outcome(
        arm,
        [episode.total_return for episode in episodes],
        [float(np.median(episode.decision_ms)) for episode in episodes],
        latency_percentiles(np.concatenate([episode.decision_ms for episode in episodes])),
        float(np.mean(differs)) if differs else None,
    )


def _split_arms(text: str) -> list[tuple[str, list[str]]]:
    """Names of the arms with their settings; a word without `=` or with `:` begins an arm."""
    arms: list[tuple[str, list[str]]] = []
    for word in (part.strip() for part in text.split(",")):
        name, colon, setting = word.partition(":")
        if colon or "=" not in word:
            arms.append((name, [setting] if colon else []))
        elif arms:
            arms[-1][1].append(word)
        else:
            raise UserError(f"{word!r} belongs to no arm; write name:{word}")
    return arms


def _parse_setting(arm: str, word: str) -> tuple[str, str]:
    field, equals, value = word.partition("=")
    if not equals:
        raise UserError(f"arm {arm!r} must be name:field=value,field=value, got {word!r}")
    if field not in field_names("planner"):
        raise_unknown("planner setting", field, field_names("planner"))
    return field, value


def _make_arm(name: str, settings: dict[str, str], base: PlannerConfig) -> Arm:
    if name in ("actor", "random"):
        return Arm(name, name, {})
    known: dict[str, dict[str, Any]] = {
        REFERENCE: {},
        "no_actor": without_actor(base),
        "no_value": {"terminal_value": False},
        "cold": {"warm_start": False},
        "horizon1": {"horizon": 1},
    }
    changes = known.get(name, settings)
    try:
        planner = build_config({"planner": override_planner(to_dict(base), changes)}).planner
    except UserError as error:
        raise UserError(f"arm {name!r}: {error}") from None
    return Arm(name, "planner", {field: getattr(planner, field) for field in changes})
