"""Imitation while learning: plans are stored where the planner acted, and pull the actor only when asked to."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.config import LearningConfig
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay, Rows
from latentplan.training import train
from latentplan.training.collection.collector import Collector
from latentplan.training.learner.module import Learner

CPU = torch.device("cpu")


@pytest.fixture
def collector(tiny, dot):
    collector = Collector(tiny("", collection={"noise_std": 0.0}), dot, "cpu")
    yield collector
    collector.close()


def weights_of(config):
    torch.manual_seed(0)
    return {name: value.numpy() for name, value in WorldModel(config.model, action_dim=1).state_dict().items()}


def rows_of(count, plan=None):
    """Rows of one episode, whose action tells the time."""
    time = np.arange(count, dtype=np.float32)
    ones = np.ones(count, np.float32)
    frames = np.zeros((count, 64, 64, 3), np.uint8)
    deter, unlabelled = np.zeros((count, 16), np.float32), np.zeros((count, 0), np.float32)
    return Rows(frames, deter, time[:, None] / 100, ones, ones, time == 0, unlabelled, plan)


def test_plans_are_stored_where_the_planner_acted_and_nowhere_else(collector, tiny):
    weights = weights_of(tiny(""))
    (planned,) = collector.collect(weights, "planner", 25, 0).rows
    last = 20  # of the first episode, without an action
    acted = np.arange(26) != last
    assert planned.plan.shape == (26, 2) and planned.plan.dtype == np.float32
    assert np.array_equal((planned.plan == 0.0).all(1), ~acted)
    assert np.allclose(planned.plan[acted, :1], planned.actions[acted])  # without noise the mean is what was done
    assert (planned.plan[acted, 1:] >= tiny("").planner.min_std).all()
    for behaviour, values in (("actor", weights), ("random", None)):
        (rows,) = collector.collect(values, behaviour, 25, 1).rows
        assert (rows.plan == 0.0).all()


def test_plans_come_back_beside_the_actions_they_led_to(tmp_path):
    replay = Replay(40, action_dim=1, deter_dim=16, num_lanes=1, device=CPU)
    time = np.arange(20, dtype=np.float32)
    replay.add(0, rows_of(20, np.stack([time / 100, time + 1], -1)))
    replay.add(0, rows_of(20))
    replay.save(tmp_path)
    again = Replay(40, action_dim=1, deter_dim=16, num_lanes=1, device=CPU)
    again.load(tmp_path)
    batch = again.gather(again.draw(64, 5, np.random.default_rng(0)))
    known = (batch.plan[..., 1:] > 0.0).expand_as(batch.plan)
    assert batch.plan.shape == (64, 5, 2) and 0 < int(known[:, 0, 0].sum()) < 64
    assert torch.equal(known, known[:, :1, :1].expand_as(known))
    assert torch.equal(batch.plan[..., :1][known[..., :1]], batch.actions[known[..., :1]])


@pytest.fixture
def batch():
    """Half of the sequences were planned: always 0.8, narrowly."""
    replay = Replay(80, action_dim=1, deter_dim=16, num_lanes=2, device=CPU)
    replay.add(0, rows_of(40, np.tile(np.float32([0.8, 0.2]), (40, 1))))
    replay.add(1, rows_of(40))
    return replay.gather(replay.draw(8, 5, np.random.default_rng(0)))


def learned(tiny, batch, updates=1, **learning):
    """A learner after updates on one batch, handed to each as Lightning would."""
    torch.manual_seed(0)
    config: LearningConfig = replace(tiny("").learning, **learning)
    replay = Replay(80, 1, 16, 2, CPU)
    learner = Learner(WorldModel(tiny("").model, action_dim=1), config, 0.9, replay, seed=0)
    optimizers = learner.configure_optimizers()
    learner.optimizers = lambda **_: optimizers
    for _ in range(updates):
        learner.training_step(batch, 0)
    learner.catch_up()
    return learner


def actor_of(learner):
    return torch.cat([parameter.detach().flatten() for parameter in learner.model.actor.parameters()])


def test_by_default_plans_teach_nothing(tiny, batch):
    plain = learned(tiny, batch)
    without = learned(tiny, batch._replace(plan=torch.zeros_like(batch.plan)))
    assert torch.equal(actor_of(plain), actor_of(without)) and float(plain.metrics["imitation"]) == 0.0


def test_plans_pull_the_actor_when_asked_to(tiny, batch):
    learner = learned(tiny, batch, 20, imitation_scale=10.0, behaviour_learning_rate=1e-2)
    states = learner.model.see(torch.zeros(1, 16), batch.frames[0, :1])
    assert float(learner.model.actor(states.features)[0].detach()) == pytest.approx(0.8, abs=0.3)
    first = learned(tiny, batch, 1, imitation_scale=10.0).metrics["imitation"]
    assert 0.0 < float(learner.metrics["imitation"]) < 0.8 * float(first)


def test_rows_without_a_plan_neither_teach_nor_break_anything(tiny, batch):
    nothing = batch._replace(plan=torch.zeros_like(batch.plan))
    plain, asked = learned(tiny, nothing), learned(tiny, nothing, imitation_scale=10.0)
    assert torch.equal(actor_of(plain), actor_of(asked)) and torch.isfinite(actor_of(asked)).all()


def test_a_run_learns_from_its_plans_and_records_it(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", learning={"imitation_scale": 0.5}, run={"frames": 75}), dot)
    with (run.run_dir / "metrics.csv").open(newline="") as file:
        losses = [float(row["imitation"]) for row in csv.DictReader(file) if row["imitation"]]
    assert losses and losses[-1] > 0.0
