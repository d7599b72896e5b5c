"""Environments by name: looks up the suite in `latentplan.config.suites` and calls the suite's factory.

A suite's factory is called as `factory(config, seed)`, with an `EnvConfig` and the seed of the first reset (None draws
one), and returns a `gymnasium.Env` with these spaces and values:

    observation_space       Box, uint8 (size, size, 3 * camera); every observation is a new array
    action_space            Box in [-1, 1], float32 (action,)
    reset                   depends on `seed` alone where one is given, else continues the random stream
    step                    holds the action for `config.action_repeat` control steps and sums the rewards
    info["env_frames"]      control steps that this step took; 0 from `reset`
    render                  the present frame, uint8 (height, width, 3)

`latentplan.envs.wrap_user_env` adapts any gymnasium environment with image observations. Further attributes are
optional; each of them enables one feature:

    decisions_per_episode   decisions until the time limit (the discount is derived from it)
    spaces                  `latentplan.config.spaces.Spaces`: the shape of frames where it is another, and
                            the numbers of the action that stand for categories
                            `info["vectors"]` then holds the numbers that the agent sees beside the frame, if any
    interface               `latentplan.envs.spaces.Interface`: names of pictures and vectors, and the action space in
                            the environment's own units, in which episodes are recorded
    labels                  scale of each named quantity; `info["labels"]` then holds the values, float32 (label,)
    render_large(size)      a larger picture, uint8 (size, size, 3), for films
    push(force), pushed_body, weight    a force on the body in newtons, (3,), for the live view; see `SuiteEnv`
    substeps_per_decision, step_schedule    actions that change within a decision, for worlds that do not wait
    record_quantities       values after each control step in `info`, for scores of objectives named at test time
"""

from __future__ import annotations

import importlib
from typing import Any

from latentplan.config import USER_DOMAIN, EnvConfig, UserError
from latentplan.config.env_id import is_by_id
from latentplan.config.suites import DEFAULT_SUITE, check_task, find_suite
from latentplan.envs.gl import render_info

USERS_RENDERER: dict[str, str | bool] = {"renderer": "the user's environment"}


def make_env(config: EnvConfig, seed: int | None = None) -> Any:
    """The environment that the settings name.

    Args:
        config: Suite, domain, task, action repeat, camera and render quality.
        seed: Seed of the environment's random stream; None draws a seed from the system.

    Raises:
        UserError: The suite, domain, task or camera does not exist, or no OpenGL library can render.
    """
    if config.domain == USER_DOMAIN:
        raise UserError(
            "this agent learned in an environment of your own that a function made: register it with gymnasium and "
            "give --env-id module:ID, or play it from Python, agent = load_agent(DIR)"
        )
    check_task(config.suite, config.domain, config.task)
    module, name = find_suite(config.suite).factory.split(":")
    return getattr(importlib.import_module(module), name)(config, seed)


def describe_renderer(config: EnvConfig) -> dict[str, str | bool]:
    """Facts about the renderer of an environment's frames; see `render_info`.

    Raises:
        UserError: No OpenGL context can be made.
    """
    return USERS_RENDERER if is_by_id(config) else render_info()


def default_task(domain: str, suite: str = DEFAULT_SUITE) -> str:
    """The usual task of a domain in benchmarks.

    Raises:
        UserError: The suite or the domain is unknown.
    """
    return check_task(suite, domain)[0]
