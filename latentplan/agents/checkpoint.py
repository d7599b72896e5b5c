"""Checkpoints: folders with the weights, settings and metrics of an agent, checked when they are read."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from latentplan.agents.base import Agent
from latentplan.agents.files import INFO, WEIGHTS, finish_renaming, seal, write_files
from latentplan.agents.info import read_contents, read_info, read_spaces, resolve_checkpoint, suggestion
from latentplan.agents.modes import MODES, make_agent
from latentplan.config import Config, PlannerConfig, UserError, from_dict, to_dict
from latentplan.config.checks import shown
from latentplan.config.estimates import check_parts, estimate_search
from latentplan.config.planner import override_planner
from latentplan.config.spaces import Spaces
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.replay.memory import free_memory

__all__ = [
    "load_agent",
    "load_model",
    "make_loaded_agent",
    "read_info",
    "resolve_checkpoint",
    "save_checkpoint",
    "seal_checkpoint",
]


def save_checkpoint(folder: Path, model: WorldModel, config: Config, info: dict[str, Any]) -> None:
    """Writes a checkpoint: float16 weights, a description and a manifest, which replace earlier ones as one commit.

    Args:
        folder: Folder of the checkpoint; a missing folder is made.
        model: The world model.
        config: Settings of the run.
        info: Further facts for the description: domain, task, discount, env_frames, metrics and the like.

    Raises:
        FloatingPointError: A weight is not finite in float16; the folder is not changed.
    """
    state = {name: value.detach().cpu().half().contiguous() for name, value in model.state_dict().items()}
    if broken := _first_not_finite(state):
        raise FloatingPointError(f"{broken} is not finite in float16: {folder} is left as it was")
    content = save(state)
    sizes = {"action_dim": model.action_dim, "labels": model.labels, "goal_dim": model.goal_dim}
    if model.spaces != Spaces():
        sizes["spaces"] = to_dict(model.spaces)
    facts = info | sizes | {"config": to_dict(config), "sha256": hashlib.sha256(content).hexdigest()}
    write_files(folder, {WEIGHTS: content, INFO: (json.dumps(facts, indent=1) + "\n").encode()})


def seal_checkpoint(path: str | Path) -> None:
    """Writes a new manifest for a checkpoint whose `info.json` was edited on purpose.

    Args:
        path: A checkpoint, or a run folder.

    Raises:
        UserError: The checkpoint cannot be used as it is now.
    """
    folder = resolve_checkpoint(path)
    finish_renaming(folder)
    _make_model(folder, *read_contents(folder, is_sealed=False), "cpu")
    seal(folder, (INFO, WEIGHTS))


@torch.inference_mode(False)  # a model made of inference tensors could be used in inference mode alone
def load_model(path: str | Path, device: str = "cpu") -> tuple[WorldModel, Config, dict[str, Any]]:
    """The world model of a checkpoint, the settings of its run, and the description (see `read_info`).

    Args:
        path: A checkpoint, or a run folder.
        device: `cpu` or `cuda`.

    Raises:
        UserError: The checkpoint is missing or damaged, another program wrote it, or the device cannot be used.
    """
    folder = resolve_checkpoint(path)
    return _make_model(folder, *read_contents(folder), device)


def load_agent(path: str | Path, mode: str = "planner", device: str = "cpu", **settings: Any) -> Agent:
    """A trained agent, ready to act.

    Args:
        path: A checkpoint, or a run folder (its best checkpoint, else its last).
        mode: `planner` (plans at every decision), `actor` (the learned policy alone), `gated` (the actor, and the
            planner at doubtful decisions; see `GatedAgent`), `background` (acts without waiting for the planner, and
            has to be closed; see `BackgroundAgent`) or `random`; see `latentplan.agents.modes`.
        device: `cpu` or `cuda`.
        **settings: For modes that plan, planner settings in place of the settings of the training, such as
            `horizon=10`. Also the mode's own options: `planning_budget` and `signal` of `gated`; `worker`, `max_age`,
            `fresh_ticks` and `make_executor` of `background`.

    Returns:
        An `Agent`: `act(frame)` takes uint8 frames (64, 64, 3) or (batch, 64, 64, 3) and returns float32 actions in
        [-1, 1], (action,) or (batch, action); call `reset()` before every episode.

    Raises:
        UserError: The checkpoint, the mode or a setting cannot be used.
    """
    _check_mode(mode, settings)  # before the weights are read
    agent = make_loaded_agent(*load_model(path, device), mode, **settings)
    wait_until_ready = getattr(agent, "wait_until_ready", None)
    if wait_until_ready is not None:
        wait_until_ready()  # without a ready worker, the actor alone would decide in the first episode
    return agent


def make_loaded_agent(
    model: WorldModel, config: Config, info: Mapping[str, Any], mode: str = "planner", **settings: Any
) -> Agent:
    """An agent that acts with a model which `load_model` returned; several agents may share the model.

    Args:
        model: The world model.
        config: The settings of its run.
        info: The description of its checkpoint.
        mode: As for `load_agent`; the worker of a `background` agent may not be ready yet.
        **settings: As for `load_agent`.

    Raises:
        UserError: The mode or a setting cannot be used.
    """
    options = _check_mode(mode, settings)
    given = {name: value for name, value in settings.items() if name not in options}
    known = to_dict(config.planner)
    for name in given:
        if name not in known:
            names = (*known, *MODES[mode].options)
            raise UserError(f"unknown planner setting {name!r}{suggestion(name, {key: key for key in names})}")
    try:
        planner = PlannerConfig(**override_planner(known, given))
        if MODES[mode].plans:
            check_parts([estimate_search(planner, config.model, model.device.type != "cpu")], free_memory())
        return make_agent(mode, model, config, info["discount"], planner=planner, **options)
    except (TypeError, ValueError) as error:
        raise UserError(f"planner settings: {error}") from None


def _make_model(
    folder: Path, info: dict[str, Any], content: bytes, device: str
) -> tuple[WorldModel, Config, dict[str, Any]]:
    """What `load_model` returns, from the description and the weights that a folder holds."""
    weights = folder / WEIGHTS
    try:
        config = from_dict(info["config"])
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"the settings in {folder / INFO} cannot be used: {error}") from None
    try:
        sizes = info["action_dim"], info.get("labels"), info.get("goal_dim") or 0, read_spaces(info)
        state = {name: value.float() for name, value in load(content).items()}
        with torch.device("meta"):  # compares shapes before a model is allocated whose size the file names
            WorldModel(config.model, *sizes).load_state_dict(state, assign=True)
        # The arrays of the file lie on the CPU, whatever torch's default device, and loading draws no random number.
        with torch.device("cpu"), torch.random.fork_rng(devices=[]):
            model = WorldModel(config.model, *sizes)
        model.load_state_dict(state)
    except (RuntimeError, SafetensorError, TypeError, ValueError) as error:
        raise UserError(f"{weights} does not fit its own settings: {str(error).splitlines()[-1].strip()}") from None
    if broken := _first_not_finite(state):
        raise UserError(f"{weights} cannot be used: {broken} is not finite")
    try:
        return accelerate(model.to(device)), config, info
    except (AssertionError, RuntimeError) as error:
        raise UserError(f"device {device!r} cannot be used: {str(error).splitlines()[0]}") from None


def _check_mode(mode: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The mode's own options among the settings.

    Raises:
        UserError: There is no such mode, or it does not plan and has settings of a planner.
    """
    if mode not in MODES:
        raise UserError(f"mode must be one of {', '.join(MODES)}, got {shown(mode)}")
    options = {name: value for name, value in settings.items() if name in MODES[mode].options}
    if len(settings) > len(options) and not MODES[mode].plans:
        first = next(name for name in settings if name not in options)
        raise UserError(f"{first} has no effect in mode {mode}: it does not plan")
    return options


def _first_not_finite(state: dict[str, torch.Tensor]) -> str | None:
    """The name of the first tensor that holds NaN or infinity; None where all are finite."""
    return next((name for name, value in state.items() if not bool(torch.isfinite(value).all())), None)
