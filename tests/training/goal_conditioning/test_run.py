"""Goals are learned in imagination, beside a model that stays as it is."""

import math
import os
import signal

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, load_model, read_info, save_checkpoint
from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.config import GoalsConfig, UserError
from latentplan.config.quantities import QUANTITIES
from latentplan.models import State, WorldModel
from latentplan.objectives.box import box_degree, box_of
from latentplan.objectives.parser import parse_objective
from latentplan.replay.buffer import Replay, Rows
from latentplan.training import learn_goals, resume_goals
from latentplan.training.folder import GOALS_FILE, claim
from latentplan.training.goal_conditioning import learner as goals
from latentplan.training.goal_conditioning.learner import Boxes, BoxSource, GoalLearner
from latentplan.training.goal_conditioning.play import describe_box
from latentplan.training.goal_conditioning.run import load_replay
from latentplan.training.learner.optimization import descend
from latentplan.training.state import INTERRUPTED

LABELS = {"height": 0.5, "speed": 1.0, "task.walk": 0.5}
INFO = {"domain": "walker", "task": "walk", "env_frames": 7, "discount": 0.9, "metrics": []}
SETTINGS = GoalsConfig(updates=6, starts=12, horizon=3, hidden_dim=8, seed=3)
ROWS = 60


def make_run(folder, config, labels):
    """A run folder with an agent and a replay of noise."""
    torch.manual_seed(0)
    model = WorldModel(config.model, 1, labels)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(parameter.half().float())
        model.dynamics.input.linear.weight[:, -1] *= 4.0
    save_checkpoint(folder / "checkpoints" / "last", model, config, INFO)
    rng = np.random.default_rng(0)
    replay = Replay(ROWS, 1, config.model.deter_dim, 1, torch.device("cpu"), len(labels))
    is_first = np.arange(ROWS) % 20 == 0
    replay.add(
        0,
        Rows(
            frames=rng.integers(0, 256, (ROWS, 64, 64, 3), dtype=np.uint8),
            deter=rng.normal(size=(ROWS, config.model.deter_dim)).astype(np.float32),
            actions=np.zeros((ROWS, 1), np.float32),
            rewards=np.zeros(ROWS, np.float32),
            continues=np.ones(ROWS, np.float32),
            is_first=is_first,
            labels=rng.normal(size=(ROWS, len(labels))).astype(np.float32),
        ),
    )
    replay.save(folder / "resume" / "replay")
    return folder


@pytest.fixture(scope="module")
def run(tiny, tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run"), tiny("", env={"domain": "walker", "action_repeat": 2}), LABELS)


@pytest.fixture(scope="module")
def finished(run, tmp_path_factory):
    return learn_goals(run, tmp_path_factory.mktemp("out") / "agent", SETTINGS)


def test_boxes_lie_around_what_was_met():
    met = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([0.1, 1.0, 3.0])
    scales = torch.tensor([0.5, 1.0, 2.0])
    source = BoxSource(met, scales, torch.Generator().manual_seed(2))
    low, high, rows = source.draw(4000, torch.Generator().manual_seed(0))
    assert low.shape == high.shape == (4000, 3) and bool((low <= high).all())
    is_open = torch.isinf(low) & torch.isinf(high)
    assert not bool(is_open.all(1).any())  # each asks for something
    closed = torch.isfinite(low) & torch.isfinite(high)
    assert bool(((high - low)[closed] <= scales.expand_as(low)[closed] + 1e-5).all())
    shares = [float(part.float().mean()) for part in (is_open, low == high, closed & (low < high))]
    # A third of the intervals is never open on both sides, three tenths of the others are.
    assert shares == pytest.approx([0.2, 0.22, 0.11], abs=0.02)
    point = low == high
    is_as_met = (low - met[rows]).abs() < 1e-5
    assert float(is_as_met[point].float().mean()) > 0.8  # in a quarter of the boxes one of the three is moved
    assert torch.equal(low, source.draw(4000, torch.Generator().manual_seed(0)).low)


def test_what_is_rare_is_asked_for_often():
    met = torch.cat([torch.zeros(9_900, 2), torch.linspace(0.0, 10.0, 100)[:, None].expand(100, 2)])
    source = BoxSource(met, torch.ones(2), torch.Generator().manual_seed(2))
    _, _, rows = source.draw(4000, torch.Generator().manual_seed(0))
    assert float((met[rows][:, 0] > 0.05).float().mean()) > 0.7  # one in a hundred of what was met


def test_nothing_but_the_heads_changes(run, finished):
    before, (after, _, info) = load_model(run)[0], load_model(finished.run_dir)
    assert finished.exit_code == 0 and 0.0 < finished.summary["worth"] < 1.0
    state = after.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in before.state_dict().items())
    assert {name.split(".")[0] for name in state.keys() - before.state_dict().keys()} == {"goal_heads"}
    assert info["goals"]["updates"] == 6 and info["goals"]["settings"]["starts"] == 12 and info["goal_dim"] == 8


def test_a_learning_that_was_cut_off_ends_with_the_same_agent(run, finished, tmp_path):
    learn_goals(run, tmp_path / "part", GoalsConfig(**vars(SETTINGS) | {"updates": 2}))
    resumed = resume_goals(tmp_path / "part", updates=6)
    weights = [load_model(folder)[0].state_dict() for folder in (finished.run_dir, resumed.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_is_asked_to_stop_finishes_the_update_in_work(run, finished, tmp_path, monkeypatch, number):
    def interrupted(optimizer, loss, max_norm, update):
        if update == 2:
            os.kill(os.getpid(), number)
        return descend(optimizer, loss, max_norm, update)

    monkeypatch.setattr(goals, "descend", interrupted)
    before = signal.getsignal(number)
    result = learn_goals(run, tmp_path / "part", SETTINGS)
    assert result.exit_code == INTERRUPTED and read_info(tmp_path / "part")["goals"]["updates"] == 3
    assert signal.getsignal(number) is before
    monkeypatch.undo()
    resumed = resume_goals(tmp_path / "part")
    weights = [load_model(folder)[0].state_dict() for folder in (finished.run_dir, resumed.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_the_imagined_worth_rises(run):
    model, config, _ = load_model(run)
    model.requires_grad_(False)
    torch.manual_seed(0)
    model.add_goal_heads(16)
    with torch.no_grad():
        model.probe_head.output.weight.normal_(std=2.0)
        model.dynamics.input.linear.weight[:, -1] *= 4.0
    settings = GoalsConfig(starts=64, horizon=4, learning_rate=1e-2, entropy_scale=0.0)
    learner = GoalLearner(model, settings, config.learning, 0.9, 2, load_replay(run / "resume" / "replay", model))
    ends = torch.full((64, 2), -math.inf)
    low, high = torch.where(torch.tensor([False, True]), 2.0, ends), -ends  # to be fast, whatever the height
    learner.source.draw = lambda num, generator: Boxes(low, high, torch.arange(num) % ROWS)

    def judge():
        start, code = State(*(part.repeat(2, 1)[:64] for part in learner.beliefs)), model.goal_heads.encode(low, high)
        with torch.no_grad(), model.trunk_precision():
            features, _ = learner.imagine(start, code, torch.Generator().manual_seed(7))
            return float(box_degree(low, high, model.goal_quantities(features[1:]), model.goal_scales).mean())

    before = judge()
    for _ in range(60):
        learner.update()
    assert judge() > before + 0.002


def test_what_is_broken_is_not_learned_from(run):
    model, config, _ = load_model(run)
    model.requires_grad_(False)
    model.add_goal_heads(8)
    with torch.no_grad():
        model.goal_heads.actor.mlp.output.bias[0] = math.nan
    learner = GoalLearner(model, SETTINGS, config.learning, 0.9, 2, load_replay(run / "resume" / "replay", model))
    with pytest.raises(FloatingPointError, match="not finite at update 0"):
        learner.update()


@pytest.mark.parametrize("mode", ["planner", "gated"])
def test_an_agent_plans_for_a_box_by_what_it_has_learned(finished, mode):
    frames = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    agent = load_agent(finished.run_dir, mode, goal_horizon=5)
    assert isinstance(agent, GatedAgent if mode == "gated" else PlanningAgent)
    agent.set_objective("speed -> 1.0 and height > 0.5")
    for frame in frames:
        assert np.isfinite(agent.act(frame)).all()
    assert agent.controller.plan.actions.shape[1] == agent.controller.planner.horizon == 2
    agent.set_objective("speed + height")
    agent.act(frames[0])
    if mode == "planner":
        assert agent.controller.plan.actions.shape[1] == 5
    agent.set_objective()
    assert agent.controller.objective is None


def test_a_search_without_values_plans_without_these_too(finished):
    agent = load_agent(finished.run_dir, terminal_value=False, goal_horizon=5)
    agent.set_objective("speed -> 1.0")
    agent.act(np.zeros((64, 64, 3), np.uint8))
    assert agent.controller.plan.actions.shape[1] == 5


def test_what_cannot_be_used_is_refused(run, finished, tiny, tmp_path):
    def refused(call, *words):
        with pytest.raises(UserError) as caught:
            call()
        assert all(word in str(caught.value) for word in words), caught.value

    refused(lambda: learn_goals(run, finished.run_dir), "already holds an agent", "--resume")
    mine = tiny("", env={"domain": "user"})
    save_checkpoint(tmp_path / "mine", WorldModel(mine.model, 1, LABELS), mine, INFO)
    refused(lambda: learn_goals(tmp_path / "mine", tmp_path / "a"), "no replay", "the folder of its run")
    with claim(finished.run_dir):
        refused(lambda: resume_goals(finished.run_dir), "another process learns")
    refused(lambda: resume_goals(run), "nothing to resume", GOALS_FILE)
    unnamed = make_run(tmp_path / "unnamed", tiny(""), {})
    refused(lambda: learn_goals(unnamed, tmp_path / "b"), "without named quantities")
    other = make_run(tmp_path / "other", tiny("", env={"domain": "walker"}), LABELS)
    learn_goals(other, tmp_path / "c", GoalsConfig(**vars(SETTINGS) | {"updates": 1}))
    model, config, info = load_model(other)
    with torch.no_grad():
        model.actor.mlp.output.bias.add_(0.5)
    save_checkpoint(other / "checkpoints" / "last", model, config, INFO)
    refused(lambda: resume_goals(tmp_path / "c"), "not the agent")
    assert "goals" in read_info(tmp_path / "c")


def test_an_agent_without_a_replay_plays_first(tiny, tmp_path):
    config = tiny("", env={"domain": "cartpole", "task": "swingup", "action_repeat": 50, "render_quality": "fastest"})
    model = WorldModel(config.model, 1, {quantity.name: quantity.scale for quantity in QUANTITIES["cartpole"]})
    save_checkpoint(tmp_path / "agent", model, config, INFO | {"domain": "cartpole", "task": "swingup"})
    settings = GoalsConfig(**vars(SETTINGS) | {"updates": 1, "play_decisions": 500})
    learn_goals(tmp_path / "agent", tmp_path / "out", settings)
    replay = load_replay(tmp_path / "out" / "replay", model)
    assert 500 <= len(replay) <= 550 and float(replay.labels.abs().sum()) > 0.0
    resumed = resume_goals(tmp_path / "out", updates=2)
    assert read_info(resumed.run_dir)["goals"]["updates"] == 2


def test_what_another_agent_played_is_not_learned_from(tiny, tmp_path, capsys):
    config = tiny("", env={"domain": "cartpole", "task": "swingup", "action_repeat": 50, "render_quality": "fastest"})
    labels = {quantity.name: quantity.scale for quantity in QUANTITIES["cartpole"]}
    settings = GoalsConfig(**vars(SETTINGS) | {"updates": 1, "play_decisions": 300})

    def begin(agent):
        torch.manual_seed(agent)
        place = tmp_path / f"agent{agent}"
        save_checkpoint(place, WorldModel(config.model, 1, labels), config, INFO | {"domain": "cartpole"})
        learn_goals(place, tmp_path / "out", settings)
        for name in ("info.json", GOALS_FILE):  # as if the machine had gone away before the first save
            (tmp_path / "out" / name).unlink()
        return "playing 300 decisions" in capsys.readouterr().out, (tmp_path / "out" / "replay/rows.pt").read_bytes()

    first, again, other = begin(0), begin(0), begin(1)
    (tmp_path / "out" / "replay" / "played.json").unlink()  # so that it may be anything
    with pytest.raises(UserError, match="holds a replay of something else"):
        begin(1)
    assert first[0] and not again[0] and other[0]
    assert first[1] == again[1] != other[1]


def test_a_box_is_asked_for_in_words():
    names, inf = ("height", "speed", "upright"), math.inf
    text = describe_box(names, (-inf, 1.0, 0.2), (inf, 1.0, 0.5))
    box = box_of(parse_objective(text, {name: 1.0 for name in names}), names)
    assert box == {"speed": (1.0, 1.0), "upright": (0.2, 0.5)}
