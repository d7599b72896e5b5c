"""The graphed update: the results of the plain learner, with nothing read back to the host."""

import copy

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from latentplan.config import Config, LearningConfig, ReplayConfig, UserError
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay, Rows
from latentplan.training.learner.graphed import WARM_UP_UPDATES, GraphedLearner
from latentplan.training.learner.module import Learner
from latentplan.training.learner.optimization import descend, load_optimizer_state

SETTINGS = {"turned_share": 0.5, "random_shift": 2}
LABELS = {"height": 0.5, "task.stand": 0.5}


class OwnOptimizers:
    """Gives a learner its own optimizers, so that it updates without a Trainer."""

    def optimizers(self, use_pl_optimizer=True):
        self.__dict__.setdefault("own", self.configure_optimizers())
        return self.own


class Plain(OwnOptimizers, Learner):
    """The plain learner, which takes batches."""


class Graphed(OwnOptimizers, GraphedLearner):
    """The graphed learner, which takes rows."""


def raise_rewards(batch):
    """Returns the batch with other rewards than the stored rewards."""
    return batch._replace(rewards=batch.rewards + 1.0)


def make_replay(device):
    replay = Replay(40, 1, 16, 1, torch.device(device), num_labels=2)
    rng = np.random.default_rng(0)
    rows = Rows(
        frames=rng.integers(0, 256, (40, 64, 64, 3), dtype=np.uint8),
        deter=rng.normal(size=(40, 16)),
        actions=rng.uniform(-1, 1, (40, 1)).astype(np.float32),
        rewards=rng.uniform(-1, 1, 40).astype(np.float32),
        continues=np.ones(40, np.float32),
        is_first=np.arange(40) % 20 == 0,
        labels=rng.normal(size=(40, 2)).astype(np.float32),
    )
    replay.add(0, rows)
    return replay


def make_learner(kind, tiny, device="cpu", **more):
    torch.manual_seed(0)
    config = tiny("", learning=SETTINGS)
    model = WorldModel(config.model, 1, LABELS)
    return kind(model.to(device), config.learning, 0.9, make_replay(device), seed=0, **more).to(device)


def make_graphed(tiny, device="cpu"):
    return make_learner(Graphed, tiny, device, prepare=raise_rewards)


def draw_rows(replay, count):
    rng = np.random.default_rng(1)
    return [replay.draw(4, 5, rng) for _ in range(count)]


def assert_same(left, right):
    pairs = zip(left.state_dict().items(), right.state_dict().items(), strict=True)
    assert all(name == other and torch.equal(one, two) for (name, one), (other, two) in pairs)
    assert torch.equal(left.replay.deter, right.replay.deter)


def test_graphed_learner_learns_as_the_plain_learner_in_turn(tiny):
    plain, graphed = make_learner(Plain, tiny), make_graphed(tiny)
    for rows in draw_rows(plain.replay, 5):
        plain.training_step(raise_rewards(plain.replay.gather(rows)), 0)
        plain.catch_up()
        graphed.training_step(rows, 0)
        graphed.catch_up()
    assert_same(plain, graphed)
    assert plain.updates == graphed.updates == 5
    assert all(torch.equal(graphed.metrics[name], value) for name, value in plain.metrics.items())


@pytest.mark.parametrize("kind", [Plain, Graphed])
def test_learner_skips_and_counts_steps_that_are_not_finite(tiny, kind):
    learner = make_graphed(tiny) if kind is Graphed else make_learner(kind, tiny)
    good, bad = draw_rows(learner.replay, 2)

    def update(rows):
        learner.training_step(rows if kind is Graphed else learner.replay.gather(rows), 0)
        learner.catch_up()
        return [[int(half.total), int(half.streak), int(half.longest)] for half in learner.skips]

    assert update(good) == [[0, 0, 0]] * 2
    before, rewards = copy.deepcopy(learner.state_dict()), learner.replay.rewards.clone()
    beliefs = learner.replay.deter.clone()
    learner.replay.rewards[bad[0, 2]] = float("nan")
    assert update(bad) == [[1, 1, 1]] * 2
    weights = {name: value for name, value in learner.state_dict().items() if name.startswith("model.")}
    assert weights and all(torch.equal(before[name], value) for name, value in weights.items())
    assert all(value.isfinite().all() for value in learner.state_dict().values())
    assert torch.equal(learner.replay.deter, beliefs)
    assert all(torch.equal(half.rows, bad) for half in learner.skips)
    assert update(bad) == [[2, 2, 2]] * 2
    learner.replay.rewards.copy_(rewards)
    assert update(good) == [[2, 0, 2]] * 2
    assert not torch.equal(before["model.actor.mlp.output.bias"], learner.model.actor.mlp.output.bias)


class RefuseReads(TorchDispatchMode):
    """Refuses operations that a graph cannot record: reads by the host, and results whose size depends on values.

    The check inside `torch.quantile` is allowed: torch 2.11 reads its argument on a CPU, but not on a GPU.
    """

    in_quantile = False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten.index.Tensor:
            refused = any(index is not None and index.dtype == torch.bool for index in args[1])
        elif func is torch.ops.aten.equal.default and RefuseReads.in_quantile:
            refused = False
        else:
            refused = {torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(func.tags)
        if refused:
            raise AssertionError(f"{func} reads a value")
        return func(*args, **(kwargs or {}))


@pytest.fixture
def watched(tiny, monkeypatch):
    """A learner after one update."""
    quantile = torch.quantile

    def marked(*arguments):
        RefuseReads.in_quantile = True
        try:
            return quantile(*arguments)
        finally:
            RefuseReads.in_quantile = False

    monkeypatch.setattr(torch, "quantile", marked)
    learner = make_graphed(tiny)
    learner.training_step(*draw_rows(learner.replay, 1), 0)
    return learner


def test_graphed_update_reads_no_value_back(watched):
    with RefuseReads():
        outputs = watched.update(torch.Generator())
    assert {"reconstruction", "probe", "actor", "value", "model_grad_norm", "behaviour_grad_norm"} <= set(outputs)


@pytest.mark.parametrize("part", ["descent", "number", "selection"])
def test_graphed_update_test_detects_a_read(watched, monkeypatch, part):
    if part == "descent":

        def read(learner, half, loss, parts, rows):
            return descend(learner._optimizers()[half], loss, learner.config.max_grad_norm, learner.updates)

        monkeypatch.setattr(Graphed, "_descend", read)
    elif part == "number":
        monkeypatch.setattr(
            watched, "prepare", lambda batch: batch._replace(rewards=batch.rewards * batch.rows.max().item())
        )
    else:
        monkeypatch.setattr(
            watched, "prepare", lambda batch: batch._replace(deter=batch.deter[batch.deter[:, 0] > -9.0])
        )
    with RefuseReads(), pytest.raises(AssertionError, match="reads a value"):
        watched.update(torch.Generator())


def test_config_refuses_a_cuda_graph_without_replay_on_the_device():
    with pytest.raises(UserError, match="cuda_graph needs replay.on_device"):
        Config(learning=LearningConfig(cuda_graph=True))
    Config(learning=LearningConfig(cuda_graph=True), replay=ReplayConfig(on_device=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_replayed_graph_learns_as_the_plain_learner_on_a_gpu(tiny):
    """The value head is reset after half the updates, so that the graph is recorded twice."""
    plain, graphed = make_learner(Plain, tiny, "cuda"), make_graphed(tiny, "cuda")
    for number, rows in enumerate(draw_rows(plain.replay, 4 * WARM_UP_UPDATES)):
        if number == 2 * WARM_UP_UPDATES:
            plain.reset_value_head()
            graphed.reset_value_head()
        plain.training_step(raise_rewards(plain.replay.gather(rows)), 0)
        plain.catch_up()
        graphed.training_step(rows, 0)
    graphed.catch_up()
    for (name, one), (_, two) in zip(plain.state_dict().items(), graphed.state_dict().items(), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4, msg=name)


def test_load_optimizer_state_keeps_the_capturable_flag_of_the_optimizer():
    weight = torch.nn.Parameter(torch.ones(2))
    saved, resumed = (torch.optim.Adam([weight], lr=1e-3, fused=True) for _ in range(2))
    weight.grad = torch.ones(2)
    saved.step()
    state = saved.state_dict()
    state["param_groups"][0]["capturable"] = True
    load_optimizer_state(resumed, state)
    assert resumed.param_groups[0]["capturable"] is False
    assert torch.equal(resumed.state[weight]["exp_avg"], saved.state[weight]["exp_avg"])
