"""The RSSM over whole sequences with written-out gradients, for GPUs, whose time is set by the number of kernels.

Autograd runs a kernel for every elementary function of every step, forwards and backwards, and accumulates the gradient
of each weight step by step. This module has one function for all work between two matrix products (`pointwise`), and
computes the gradients of weights once over all steps. A whole update then needs two fifths of the kernels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from latentplan.models.dynamics import Gaussian, State
from latentplan.models.fast import pointwise
from latentplan.models.fast.pointwise import run
from latentplan.models.heads import NormedLinear, sample_action

if TYPE_CHECKING:
    from latentplan.models.dynamics import Rssm
    from latentplan.models.heads import Actor, Mlp

Parts = Sequence[Tensor | None]


class Weights(NamedTuple):
    """Parameters of a step: of the GRU, and of the layers from deter to the latent (prior or posterior)."""

    input: Tensor
    input_scale: Tensor
    input_shift: Tensor
    gates: Tensor
    gates_scale: Tensor
    gates_shift: Tensor
    hidden: Tensor
    hidden_scale: Tensor
    hidden_shift: Tensor
    output: Tensor
    output_bias: Tensor


def observe(
    dynamics: Rssm, embeddings: Tensor, actions: Tensor, deter: Tensor, noise: Tensor
) -> tuple[State, Gaussian]:
    """The same as `Rssm.observe`; gradients reach the weights and the embeddings."""
    deter, *latent = _Unrolled.apply(embeddings, actions, deter, None, noise, *collect_weights(dynamics, prior=False))
    return State(deter, latent[0]), Gaussian(*latent[1:])


def predict(dynamics: Rssm, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
    """The same as `Rssm.predict`; gradients reach the weights alone."""
    weights = collect_weights(dynamics, prior=True)
    deter, _, *prior = _Unrolled.apply(None, actions, start.deter, start.stoch, None, *weights)
    return deter, Gaussian(*prior)


def imagine(
    dynamics: Rssm, actor: Actor, start: State, action_noise: Tensor, noise: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """The same as `Dynamics.imagine` with an actor as the policy; gradients reach the actor through the dynamics.

    Args:
        dynamics: The dynamics; their weights get no gradient.
        actor: The policy, which reads states without a gradient.
        start: States, (rows, ...) each, without a gradient.
        action_noise: Standard normal draws for the actions, (horizon, rows, action).
        noise: Standard normal draws for the latents, (horizon, rows, latent).
        decay: Share of a state's gradient that a step passes back to the state before.

    Returns:
        Features, the start first, (horizon + 1, rows, feature); std of the actions, (horizon, rows, action).
    """
    steps, deter, stoch, features = _Steps(collect_weights(dynamics, prior=True)), *start, [start.features]
    with torch.no_grad():
        for action_draws, draws in zip(action_noise.unbind(), noise.unbind(), strict=True):
            inputs = run(pointwise.append_action, _apply_mlp(actor.mlp, features[-1]), action_draws, stoch)
            deter = steps.advance(inputs, deter)
            stoch, sampled = run(pointwise.sample_features, steps.read(deter, None), draws, deter)
            features.append(sampled)
        stacked = torch.stack(features)
    # The actor runs once more on all states at once, because its gradient needs no recurrence.
    mean, std = actor(stacked[:-1])
    actions = sample_action(mean, std, action_noise)
    return _Imagined.apply(actions, stacked, steps, noise, decay), std


def _apply_mlp(mlp: Mlp, features: Tensor) -> Tensor:
    for part in mlp.trunk:
        assert isinstance(part, NormedLinear)
        features = run(pointwise.norm_silu, features @ part.linear.weight.T, part.norm.weight, part.norm.bias)
    return torch.addmm(mlp.output.bias, features, mlp.output.weight.T)


def collect_weights(dynamics: Rssm, *, prior: bool) -> Weights:
    """The parameters of steps that read the latent from the prior, or else from the posterior."""
    first, gates, norm = dynamics.input, dynamics.gates, dynamics.gates_norm
    advance = (first.linear.weight, first.norm.weight, first.norm.bias, gates.weight, norm.weight, norm.bias)
    hidden, norm, output = dynamics.posterior_deter, dynamics.posterior_norm, dynamics.posterior_output
    if prior:
        hidden, norm, output = dynamics.prior_hidden.linear, dynamics.prior_hidden.norm, dynamics.prior_output
    return Weights(*advance, hidden.weight, norm.weight, norm.bias, output.weight, output.bias)


class _Steps:
    """Intermediate results of each step, kept for the gradients."""

    def __init__(self, weights: Weights) -> None:
        self.weights = weights
        self.inputs: list[Tensor] = []  # latent and action, concatenated
        self.first: list[Tensor] = []  # product of `inputs` with the input weights
        self.gate_inputs: list[Tensor] = []  # hidden layer of the input, concatenated with deter
        self.gates: list[Tensor] = []  # product of `gate_inputs` with the weights of the gates
        self.before: list[Tensor] = []  # deter before the step
        self.after: list[Tensor] = []  # deter after the step
        self.second: list[Tensor] = []  # product of `after` with the hidden weights
        self.hidden: list[Tensor] = []  # hidden layer between deter and latent
        self.raw: list[Tensor] = []  # raw mean and std of the latent

    def advance(self, inputs: Tensor, deter: Tensor) -> Tensor:
        """The next deter, for latent and action concatenated."""
        weights = self.weights
        first = inputs @ weights.input.T
        gate_inputs = run(pointwise.norm_silu_with_deter, first, weights.input_scale, weights.input_shift, deter)
        gates = gate_inputs @ weights.gates.T
        self.inputs.append(inputs)
        self.first.append(first)
        self.gate_inputs.append(gate_inputs)
        self.gates.append(gates)
        self.before.append(deter)
        return run(pointwise.update_deter, gates, weights.gates_scale, weights.gates_shift, deter)

    def read(self, deter: Tensor, embedding: Tensor | None) -> Tensor:
        """Raw mean and std of the latent at a deter, (rows, 2 latent), before `gaussian`."""
        weights = self.weights
        second = deter @ weights.hidden.T if embedding is None else torch.addmm(embedding, deter, weights.hidden.T)
        hidden = run(pointwise.norm_silu, second, weights.hidden_scale, weights.hidden_shift)
        self.after.append(deter)
        self.second.append(second)
        self.hidden.append(hidden)
        self.raw.append(torch.addmm(weights.output_bias, hidden, weights.output.T))
        return self.raw[-1]


class _Gradients:
    """The backward pass through the steps, from the last to the first."""

    def __init__(self, steps: _Steps, noise: Parts, decay: float = 1.0) -> None:
        self.steps, self.noise, self.decay = steps, noise, decay
        # Gradients of deter through the following step, which the backward pass visits first.
        self.later: tuple[Tensor, Tensor] | tuple[None, None] = (None, None)
        self.inputs: list[Tensor] = []
        self.first: list[tuple[Tensor, Tensor]] = []  # of the product, and of the scaled norm
        self.gates: list[tuple[Tensor, Tensor]] = []
        self.second: list[tuple[Tensor, Tensor]] = []
        self.raw: list[Tensor] = []

    def read(self, time: int, stoch: Tensor | None, mean: Tensor | None, std: Tensor | None) -> Tensor:
        """The gradient of a step's deter through its latent, given the losses' gradients of stoch, mean and std."""
        steps, weights = self.steps, self.steps.weights
        inputs = self.inputs[-1] if self.inputs else None
        raw = run(pointwise.sample_latent_back, steps.raw[time], self.noise[time], stoch, mean, std, inputs, self.decay)
        second = run(
            pointwise.norm_silu_back,
            raw @ weights.output,
            steps.second[time],
            weights.hidden_scale,
            weights.hidden_shift,
        )
        self.raw.append(raw)
        self.second.append(second)
        return second[0] @ weights.hidden

    def advance(self, index: int, by_latent: Tensor, deter: Tensor | None) -> None:
        """Computes the gradients of a step's GRU.

        Args:
            index: The step, counted from the first action.
            by_latent: Gradient of the next deter through the latent of the same step.
            deter: Gradient of the next deter through other readers, such as losses.
        """
        steps, weights = self.steps, self.steps.weights
        gates, normed, directly = run(
            pointwise.update_deter_back,
            by_latent,
            deter,
            *self.later,
            self.decay,
            steps.gates[index],
            weights.gates_scale,
            weights.gates_shift,
            steps.before[index],
        )
        gate_inputs = gates @ weights.gates
        first = run(pointwise.norm_silu_back, gate_inputs, steps.first[index], weights.input_scale, weights.input_shift)
        self.later = directly, gate_inputs
        self.gates.append((gates, normed))
        self.first.append(first)
        self.inputs.append(first[0] @ weights.input)

    def collect(self) -> tuple[Tensor, ...]:
        """Gradients of all parameters, in the order of `Weights`, over all steps at once."""
        steps = self.steps
        return (
            *_collect_gradients(self.first, steps.inputs, steps.first),
            *_collect_gradients(self.gates, steps.gate_inputs, steps.gates),
            *_collect_gradients(self.second, steps.after, steps.second),
            (raw := torch.cat(self.raw[::-1])).T @ torch.cat(steps.hidden),
            raw.sum(0),
        )


def _collect_gradients(
    gradients: list[tuple[Tensor, Tensor]], inputs: list[Tensor], products: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of a layer's weight, and of its norm's scale and shift."""
    of_products, normed = (torch.cat(part[::-1]) for part in zip(*gradients, strict=True))
    return of_products.T @ torch.cat(inputs), *run(pointwise.norm_back, normed, torch.cat(products))


class _Unrolled(torch.autograd.Function):
    """deter, stoch, mean and std of each step, (rows, time, ...) each.

    With embeddings, the first step has a frame and no action. Without embeddings, the first step takes an action from
    deter and stoch.
    """

    @staticmethod
    def forward(
        ctx: Any,
        embeddings: Tensor | None,
        actions: Tensor,
        deter: Tensor,
        stoch: Tensor | None,
        noise: Tensor | None,
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        steps, has_frames = _Steps(Weights(*parameters)), embeddings is not None
        length = actions.shape[1] + has_frames
        frames, draws = _split_time(embeddings, length), _split_time(noise, length)
        following = [*actions.unbind(1), None][1 - has_frames :]
        inputs = None if stoch is None else torch.cat([stoch, actions[:, 0]], -1)
        latents = []
        for time in range(length):
            if inputs is not None:
                deter = steps.advance(inputs, deter)
            *latent, inputs = run(
                pointwise.sample_latent, steps.read(deter, frames[time]), draws[time], following[time]
            )
            latents.append(latent)
        ctx.steps, ctx.draws, ctx.has_frames = steps, draws, has_frames
        ctx.set_materialize_grads(False)
        return torch.stack(steps.after, 1), *(torch.stack(part, 1) for part in zip(*latents, strict=True))

    @staticmethod
    def backward(ctx: Any, *outer: Tensor | None) -> tuple[Tensor | None, ...]:
        length = len(ctx.steps.raw)
        gradients = _Gradients(ctx.steps, ctx.draws)
        of_deter, *of_latent = (_split_time(part, length) for part in outer)
        for time in reversed(range(length)):
            by_latent = gradients.read(time, *(part[time] for part in of_latent))
            if time >= ctx.has_frames:
                gradients.advance(time - ctx.has_frames, by_latent, of_deter[time])
        of_frames = torch.stack([product for product, _ in gradients.second[::-1]], 1) if ctx.has_frames else None
        return (of_frames, None, None, None, None, *gradients.collect())


class _Imagined(torch.autograd.Function):
    """Imagined features (horizon + 1, rows, feature) as a function of the actions (horizon, rows, action)."""

    @staticmethod
    def forward(ctx: Any, actions: Tensor, features: Tensor, steps: _Steps, noise: Tensor, decay: float) -> Tensor:
        ctx.steps, ctx.noise, ctx.decay = steps, noise.unbind(), decay
        return features.view_as(features)

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor | None, ...]:
        steps: _Steps = ctx.steps
        gradients = _Gradients(steps, ctx.noise, ctx.decay)
        sizes = [steps.after[0].shape[-1], steps.raw[0].shape[-1] // 2]
        deter, stoch = (part.unbind() for part in outer[1:].split(sizes, -1))
        for time in reversed(range(len(steps.raw))):
            gradients.advance(time, gradients.read(time, stoch[time], None, None), deter[time])
        actions = torch.stack([inputs[:, sizes[1] :] for inputs in gradients.inputs[::-1]])
        return actions, None, None, None, None


def _split_time(part: Tensor | None, length: int) -> Parts:
    return [None] * length if part is None else part.unbind(1)
