"""The GRU over whole sequences with written-out gradients, for GPUs, where the number of kernels sets the time.

Autograd runs a kernel for every elementary function of every step, forwards and backwards, and accumulates the gradient
of each weight step by step. Here the work between two matrix products is one function (`pointwise`), and the gradients
of weights are computed once over all steps. A whole update then needs two fifths of the kernels.
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
    """`Rssm.observe`; gradients reach the weights and the embeddings."""
    deter, *latent = _Unrolled.apply(embeddings, actions, deter, None, noise, *_weights(dynamics, prior=False))
    return State(deter, latent[0]), Gaussian(*latent[1:])


def predict(dynamics: Rssm, start: State, actions: Tensor) -> tuple[Tensor, Gaussian]:
    """`Rssm.predict`; gradients reach the weights alone."""
    deter, _, *prior = _Unrolled.apply(None, actions, start.deter, start.stoch, None, *_weights(dynamics, prior=True))
    return deter, Gaussian(*prior)


def imagine(
    dynamics: Rssm, actor: Actor, start: State, action_noise: Tensor, noise: Tensor, decay: float
) -> tuple[Tensor, Tensor]:
    """`Dynamics.imagine` with an actor as the policy; gradients reach the actor through the dynamics.

    Args:
        dynamics: The dynamics; their weights get no gradient.
        actor: The policy; it reads its states without a gradient.
        start: States, (rows, ...) each, without a gradient.
        action_noise: Standard normal draws for the actions, (horizon, rows, action).
        noise: Standard normal draws for the latents, (horizon, rows, latent).
        decay: Share of a state's gradient that a step passes back to the state before.

    Returns:
        Features, the start first, (horizon + 1, rows, feature); std of the actions, (horizon, rows, action).
    """
    steps, deter, stoch, features = _Steps(_weights(dynamics, prior=True)), *start, [start.features]
    with torch.no_grad():
        for action_draws, draws in zip(action_noise.unbind(), noise.unbind(), strict=True):
            joined = run(pointwise.append_action, _outputs(actor.mlp, features[-1]), action_draws, stoch)
            deter = steps.advance(joined, deter)
            stoch, seen = run(pointwise.sample_features, steps.read(deter, None), draws, deter)
            features.append(seen)
        stacked = torch.stack(features)
    # The actor's own gradient needs no recurrence: the actor runs once more, on all states at once.
    mean, std = actor(stacked[:-1])
    actions = sample_action(mean, std, action_noise)
    return _Imagined.apply(actions, stacked, steps, noise, decay), std


def _outputs(mlp: Mlp, features: Tensor) -> Tensor:
    for part in mlp.trunk:
        assert isinstance(part, NormedLinear)
        features = run(pointwise.norm_silu, features @ part.linear.weight.T, part.norm.weight, part.norm.bias)
    return torch.addmm(mlp.output.bias, features, mlp.output.weight.T)


def _weights(dynamics: Rssm, *, prior: bool) -> Weights:
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
        self.joined: list[Tensor] = []  # latent and action, concatenated
        self.first: list[Tensor] = []  # product of `joined` with the input weights
        self.beside: list[Tensor] = []  # hidden layer of the input, concatenated with deter
        self.gates: list[Tensor] = []  # product of `beside` with the weights of the gates
        self.before: list[Tensor] = []  # deter before the step
        self.after: list[Tensor] = []  # deter after the step
        self.second: list[Tensor] = []  # product of `after` with the hidden weights
        self.hidden: list[Tensor] = []  # hidden layer between deter and latent
        self.raw: list[Tensor] = []  # raw mean and std of the latent

    def advance(self, joined: Tensor, deter: Tensor) -> Tensor:
        """The next deter, for latent and action concatenated."""
        weights = self.weights
        first = joined @ weights.input.T
        beside = run(pointwise.norm_silu_with_deter, first, weights.input_scale, weights.input_shift, deter)
        gates = beside @ weights.gates.T
        self.joined.append(joined)
        self.first.append(first)
        self.beside.append(beside)
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
        self.later: tuple[Tensor, Tensor] | tuple[None, None] = (
            None,
            None,
        )  # gradients of deter through the following step
        self.joined: list[Tensor] = []
        self.first: list[tuple[Tensor, Tensor]] = []  # of the product, and of the scaled norm
        self.gates: list[tuple[Tensor, Tensor]] = []
        self.second: list[tuple[Tensor, Tensor]] = []
        self.raw: list[Tensor] = []

    def read(self, time: int, stoch: Tensor | None, mean: Tensor | None, std: Tensor | None) -> Tensor:
        """The gradient of a step's deter through its latent, given outer gradients of stoch, mean and std."""
        steps, weights = self.steps, self.steps.weights
        joined = self.joined[-1] if self.joined else None
        raw = run(pointwise.sample_latent_back, steps.raw[time], self.noise[time], stoch, mean, std, joined, self.decay)
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
        """Backward through a step's GRU, given gradients of its deter through its latent and through other readers."""
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
        beside = gates @ weights.gates
        first = run(pointwise.norm_silu_back, beside, steps.first[index], weights.input_scale, weights.input_shift)
        self.later = directly, beside
        self.gates.append((gates, normed))
        self.first.append(first)
        self.joined.append(first[0] @ weights.input)

    def of_weights(self) -> tuple[Tensor, ...]:
        """Gradients of all parameters, in the order of `Weights`, over all steps at once."""
        steps = self.steps
        return (
            *_through_norm(self.first, steps.joined, steps.first),
            *_through_norm(self.gates, steps.beside, steps.gates),
            *_through_norm(self.second, steps.after, steps.second),
            (raw := torch.cat(self.raw[::-1])).T @ torch.cat(steps.hidden),
            raw.sum(0),
        )


def _through_norm(
    gradients: list[tuple[Tensor, Tensor]], inputs: list[Tensor], products: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of a layer's weight, and of its norm's scale and shift."""
    of_products, normed = (torch.cat(part[::-1]) for part in zip(*gradients, strict=True))
    return of_products.T @ torch.cat(inputs), *run(pointwise.norm_back, normed, torch.cat(products))


class _Unrolled(torch.autograd.Function):
    """deter, stoch, mean and std of each step, (rows, time, ...) each.

    With embeddings the first step only reads its frame; without them it begins with an action, from deter and stoch.
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
        seen, draws = _slices(embeddings, length), _slices(noise, length)
        acts = [*actions.unbind(1), None][1 - has_frames :]
        joined = None if stoch is None else torch.cat([stoch, actions[:, 0]], -1)
        read = []
        for time in range(length):
            if joined is not None:
                deter = steps.advance(joined, deter)
            *latent, joined = run(pointwise.sample_latent, steps.read(deter, seen[time]), draws[time], acts[time])
            read.append(latent)
        ctx.steps, ctx.draws, ctx.has_frames = steps, draws, has_frames
        ctx.set_materialize_grads(False)
        return torch.stack(steps.after, 1), *(torch.stack(part, 1) for part in zip(*read, strict=True))

    @staticmethod
    def backward(ctx: Any, *outer: Tensor | None) -> tuple[Tensor | None, ...]:
        length = len(ctx.steps.raw)
        gradients = _Gradients(ctx.steps, ctx.draws)
        of_deter, *of_latent = (_slices(part, length) for part in outer)
        for time in reversed(range(length)):
            by_latent = gradients.read(time, *(part[time] for part in of_latent))
            if time >= ctx.has_frames:
                gradients.advance(time - ctx.has_frames, by_latent, of_deter[time])
        seen = torch.stack([product for product, _ in gradients.second[::-1]], 1) if ctx.has_frames else None
        return (seen, None, None, None, None, *gradients.of_weights())


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
        actions = torch.stack([joined[:, sizes[1] :] for joined in gradients.joined[::-1]])
        return actions, None, None, None, None


def _slices(part: Tensor | None, length: int) -> Parts:
    return [None] * length if part is None else part.unbind(1)
