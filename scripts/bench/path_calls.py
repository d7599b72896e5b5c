"""Calls of the world model that `benchmark.py paths` times."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from latentplan.config import LearningConfig
from latentplan.models import State, WorldModel

Calls = dict[str, Callable[[WorldModel], Any]]


def planner_calls(model: WorldModel, rows: int, horizon: int) -> Calls:
    """Calls of a search, without gradients."""
    state, actions = _states(model, rows), _actions(model, rows, horizon)
    noise = torch.randn_like(actions)

    def without_gradients(call: Callable[[WorldModel], Any]) -> Callable[[WorldModel], Any]:
        return torch.no_grad()(call)

    return {
        f"rollout of {rows}": without_gradients(lambda model: model.rollout(state, actions)),
        f"proposals of {rows}": without_gradients(lambda model: model.backend.propose(model, state, noise)),
        f"step of {rows}": without_gradients(lambda model: model.fast_step(state, actions[:, 0])),
        f"value of {rows}": without_gradients(lambda model: model.value(state)),
    }


def frame_calls(model: WorldModel) -> Calls:
    """The belief update and the actor for one frame."""
    state, action = _states(model, 1), _actions(model, 1, 1)[:, 0]
    frames = torch.randint(0, 256, (1, 64, 64, 3), dtype=torch.uint8, device=model.device)

    @torch.inference_mode()
    def decide(model: WorldModel) -> Any:
        return model.backend.frame_functions(model).infer_and_act(state, action, frames)

    return {"one frame": decide}


def learner_calls(model: WorldModel, learning: LearningConfig) -> Calls:
    """Forward and backward passes of a learner, and the slow copies of weights."""
    batch, time, sizes, device = learning.batch_size, learning.sequence_length, model.config, model.device
    embeddings = torch.randn(batch, time + 1, sizes.hidden_dim, device=device, requires_grad=True)
    noise = torch.randn(batch, time + 1, sizes.latent_dim, device=device)
    actions, deter = _actions(model, batch, time), torch.zeros(batch, sizes.deter_dim, device=device)
    windows = max(1, learning.overshooting_horizon)
    starts = _states(model, batch * max(1, time // windows))
    following = _actions(model, len(starts.deter), windows)
    first, horizon = _states(model, learning.imagination_starts), learning.imagination_horizon
    action_noise = torch.randn(horizon, len(first.deter), model.action_dim, device=device)
    latent_noise = torch.randn(horizon, len(first.deter), sizes.latent_dim, device=device)
    frames = torch.randint(0, 256, (batch * (time + 1), 64, 64, 3), dtype=torch.uint8, device=device)
    features = torch.cat(_states(model, len(frames)), -1).requires_grad_()
    imagined = torch.cat(_states(model, horizon * len(first.deter)), -1).requires_grad_()
    slow = [parameter.detach().clone() for parameter in model.parameters()]
    latest = [parameter.detach() for parameter in model.parameters()]

    def observe(model: WorldModel) -> None:
        _run_backward(*model.backend.observe(model, embeddings, actions, deter, noise))

    def predict(model: WorldModel) -> None:
        deters, prior = model.backend.predict(model, starts, following)
        _run_backward((deters,), prior)

    def imagine(model: WorldModel) -> None:
        _run_backward(model.backend.imagine(model, first, action_noise, latent_noise, learning.gradient_decay))

    def encode(model: WorldModel) -> None:
        with model.trunk_precision():
            embedded = model.backend.encode(model, frames)
        _run_backward((embedded,))

    def reconstruct(model: WorldModel) -> None:
        with model.trunk_precision():
            errors = model.backend.reconstruction_errors(model, features, frames)
        _run_backward((errors,))

    def value(model: WorldModel) -> None:
        with model.trunk_precision():
            logits = model.backend.apply(model.value_head.mlp, imagined)
        _run_backward((model.backend.mean(model.value_head, logits),))

    calls: Calls = {
        "encoder, with gradients": encode,
        "reconstruction, with gradients": reconstruct,
        "observation, with gradients": observe,
        "open-loop prediction, with gradients": predict,
        "imagination, with gradients": imagine,
        "values of imagined states, with gradients": value,
    }
    if device.type == "cuda":
        calls["moving averages, all tensors at once"] = lambda model: model.backend.move_towards(slow, latest, 0.01)
    return calls


def augmentation_calls(model: WorldModel, learning: LearningConfig) -> Calls:
    """Shifts and quarter turns of replayed frames."""
    batch, pixels = learning.batch_size, max(1, learning.random_shift)
    size = (batch, learning.sequence_length + 1, 64, 64, 3)
    frames = torch.randint(0, 256, size, dtype=torch.uint8, device=model.device)
    offsets = torch.randint(2 * pixels + 1, (batch, 2), device=model.device)
    amounts = torch.randint(4, (batch,), device=model.device)
    return {
        "shifted frames, by slices": lambda model: model.backend.shift_frames(frames, offsets, pixels),
        "turned frames, by slices": lambda model: model.backend.turn_frames(frames, amounts),
    }


def _states(model: WorldModel, rows: int) -> State:
    sizes = (model.config.deter_dim, model.config.latent_dim)
    return State(*(torch.randn(rows, size, device=model.device).tanh() for size in sizes))


def _actions(model: WorldModel, rows: int, time: int) -> torch.Tensor:
    return torch.rand(rows, time, model.action_dim, device=model.device) * 2.0 - 1.0


def _run_backward(*outputs: tuple[torch.Tensor, ...]) -> None:
    torch.stack([part.sum() for parts in outputs for part in parts]).sum().backward()
