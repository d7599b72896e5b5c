"""Goal conditioning: goal heads learn in imagination, and the rest of the agent stays as it is."""

import math
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

from latentplan.agents.checkpoint import load_agent, load_model, read_info, save_checkpoint
from latentplan.agents.gated import GatedAgent
from latentplan.agents.planning import PlanningAgent
from latentplan.commands.main import main
from latentplan.config import GoalsConfig, UserError, to_dict
from latentplan.config.commit import Saves
from latentplan.config.files import dump_config
from latentplan.config.quantities import QUANTITIES
from latentplan.config.run_folder import lock_folder, run_saves
from latentplan.config.spaces import Spaces
from latentplan.models import State, WorldModel
from latentplan.objectives.box import box_degree, box_of
from latentplan.objectives.parser import parse_objective
from latentplan.replay.buffer import Replay, Rows
from latentplan.replay.disk import ReplayFiles
from latentplan.training import learn_goals, resume_goals
from latentplan.training.goal_conditioning import learner as goal_learner
from latentplan.training.goal_conditioning import run as goal_run
from latentplan.training.goal_conditioning.learner import Boxes, BoxSource, GoalLearner
from latentplan.training.goal_conditioning.run import describe_box, load_replay, read_resumed
from latentplan.training.learner.optimization import descend

LABELS = {"height": 0.5, "speed": 1.0, "task.walk": 0.5}
INFO = {"domain": "walker", "task": "walk", "env_frames": 7, "discount": 0.9, "metrics": []}
SETTINGS = GoalsConfig(updates=6, starts=12, horizon=3, hidden_dim=8, seed=3)
ROWS = 60


def make_run(folder, config, labels):
    """Makes a run folder with an untrained agent and a replay of random rows."""
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
    run_saves(folder).commit(ReplayFiles(folder / "resume", replay).write, {"env_frames": ROWS})
    dump_config(config, folder / "config.yaml")
    return folder


def read_replay(run, model):
    return load_replay(run_saves(run).newest()[0], model)


@pytest.fixture(scope="module")
def run(tiny, tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("run"), tiny("", env={"domain": "walker", "action_repeat": 2}), LABELS)


@pytest.fixture(scope="module")
def finished(run, tmp_path_factory):
    return learn_goals(run, tmp_path_factory.mktemp("out") / "agent", SETTINGS)


def test_box_source_draws_boxes_around_observed_quantities():
    observed = torch.randn(500, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([0.1, 1.0, 3.0])
    scales = torch.tensor([0.5, 1.0, 2.0])
    source = BoxSource(observed, scales, torch.Generator().manual_seed(2))
    low, high, rows = source.draw(4000, torch.Generator().manual_seed(0))
    assert low.shape == high.shape == (4000, 3) and bool((low <= high).all())
    is_open = torch.isinf(low) & torch.isinf(high)
    assert not bool(is_open.all(1).any())  # every box bounds some quantity
    closed = torch.isfinite(low) & torch.isfinite(high)
    assert bool(((high - low)[closed] <= scales.expand_as(low)[closed] + 1e-5).all())
    shares = [float(part.float().mean()) for part in (is_open, low == high, closed & (low < high))]
    # A third of the intervals is never open on both sides, three tenths of the others are.
    assert shares == pytest.approx([0.2, 0.22, 0.11], abs=0.02)
    point = low == high
    is_observed = (low - observed[rows]).abs() < 1e-5
    assert float(is_observed[point].float().mean()) > 0.8  # a quarter of the boxes moves one of three centres
    assert torch.equal(low, source.draw(4000, torch.Generator().manual_seed(0)).low)


def test_box_source_draws_rare_values_often():
    observed = torch.cat([torch.zeros(9_900, 2), torch.linspace(0.0, 10.0, 100)[:, None].expand(100, 2)])
    source = BoxSource(observed, torch.ones(2), torch.Generator().manual_seed(2))
    _, _, rows = source.draw(4000, torch.Generator().manual_seed(0))
    assert float((observed[rows][:, 0] > 0.05).float().mean()) > 0.7  # 1 % of the observed rows


def test_learn_goals_changes_only_the_goal_heads(run, finished):
    before, (after, _, info) = load_model(run)[0], load_model(finished.run_dir)
    assert finished.exit_code == 0 and 0.0 < finished.summary["worth"] < 1.0
    state = after.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in before.state_dict().items())
    assert {name.split(".")[0] for name in state.keys() - before.state_dict().keys()} == {"goal_heads"}
    assert info["goals"]["updates"] == 6 and info["goals"]["settings"]["starts"] == 12 and info["goal_dim"] == 8


def test_resume_goals_ends_with_the_agent_of_an_uninterrupted_learning(run, finished, tmp_path):
    learn_goals(run, tmp_path / "part", GoalsConfig(**vars(SETTINGS) | {"updates": 2}))
    resumed = resume_goals(tmp_path / "part", updates=6)
    weights = [load_model(folder)[0].state_dict() for folder in (finished.run_dir, resumed.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_goals_that_were_killed_while_their_first_save_was_written_go_on(run, finished, tmp_path, monkeypatch):
    def kill(*arguments):
        raise KeyError("killed")

    with monkeypatch.context() as patch:
        patch.setattr(goal_run, "save_checkpoint", kill)
        with pytest.raises(KeyError, match="killed"):
            learn_goals(run, tmp_path / "part", SETTINGS)
    resumed = resume_goals(tmp_path / "part")
    weights = [load_model(folder)[0].state_dict() for folder in (finished.run_dir, resumed.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_read_resumed_takes_saved_settings_with_a_new_budget(finished):
    assert read_resumed(finished.run_dir)[1] == SETTINGS
    assert read_resumed(finished.run_dir, updates=99, minutes=2.0)[1] == replace(SETTINGS, updates=99, minutes=2.0)


def test_goals_prints_the_settings_with_which_it_resumes(finished, capsys):
    assert main(["goals", "--resume", str(finished.run_dir), "--updates", "99", "--print-config"]) == 0
    assert yaml.safe_load(capsys.readouterr().out)["settings"] == to_dict(SETTINGS) | {"updates": 99}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_learn_goals_finishes_the_running_update_when_a_signal_arrives(run, finished, tmp_path, monkeypatch, number):
    def interrupted(optimizer, loss, max_norm, update):
        if update == 2:
            os.kill(os.getpid(), number)
        return descend(optimizer, loss, max_norm, update)

    monkeypatch.setattr(goal_learner, "descend", interrupted)
    before = signal.getsignal(number)
    result = learn_goals(run, tmp_path / "part", SETTINGS)
    assert result.exit_code == 128 + number and read_info(tmp_path / "part")["goals"]["updates"] == 3
    assert signal.getsignal(number) is before
    monkeypatch.undo()
    resumed = resume_goals(tmp_path / "part")
    weights = [load_model(folder)[0].state_dict() for folder in (finished.run_dir, resumed.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_goal_learner_raises_the_imagined_worth(run):
    model, config, _ = load_model(run)
    model.requires_grad_(False)
    torch.manual_seed(0)
    model.add_goal_heads(16)
    with torch.no_grad():
        model.probe_head.output.weight.normal_(std=2.0)
        model.dynamics.input.linear.weight[:, -1] *= 4.0
    settings = GoalsConfig(starts=64, horizon=4, learning_rate=1e-2, entropy_scale=0.0)
    learner = GoalLearner(model, settings, config.learning, 0.9, 2, load_replay(run_saves(run).newest()[0], model))
    ends = torch.full((64, 2), -math.inf)
    low, high = torch.where(torch.tensor([False, True]), 2.0, ends), -ends  # a high speed at any height
    learner.source.draw = lambda num, generator: Boxes(low, high, torch.arange(num) % ROWS)

    def mean_degree():
        start, code = State(*(part.repeat(2, 1)[:64] for part in learner.beliefs)), model.goal_heads.encode(low, high)
        with torch.no_grad(), model.trunk_precision():
            features, _ = learner.imagine(start, code, torch.Generator().manual_seed(7))
            return float(box_degree(low, high, model.goal_quantities(features[1:]), model.goal_scales).mean())

    before = mean_degree()
    for _ in range(60):
        learner.update()
    assert mean_degree() > before + 0.002


def test_goal_learner_raises_when_the_gradient_is_not_finite(run):
    model, config, _ = load_model(run)
    model.requires_grad_(False)
    model.add_goal_heads(8)
    with torch.no_grad():
        model.goal_heads.actor.mlp.output.bias[0] = math.nan
    learner = GoalLearner(model, SETTINGS, config.learning, 0.9, 2, load_replay(run_saves(run).newest()[0], model))
    with pytest.raises(FloatingPointError, match="not finite at update 0"):
        learner.update()


@pytest.mark.parametrize("mode", ["planner", "gated"])
def test_agent_plans_with_the_goal_value_for_a_box(finished, mode):
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


def test_agent_plans_over_the_goal_horizon_without_terminal_value(finished):
    agent = load_agent(finished.run_dir, terminal_value=False, goal_horizon=5)
    agent.set_objective("speed -> 1.0")
    agent.act(np.zeros((64, 64, 3), np.uint8))
    assert agent.controller.plan.actions.shape[1] == 5


def test_learn_goals_refuses_folders_and_agents_it_cannot_use(run, finished, tiny, tmp_path):
    def refused(call, *words):
        with pytest.raises(UserError) as caught:
            call()
        assert all(word in str(caught.value) for word in words), caught.value

    refused(lambda: learn_goals(run, finished.run_dir), "already holds an agent", "--resume")
    mine = tiny("", env={"domain": "user"})
    save_checkpoint(tmp_path / "mine", WorldModel(mine.model, 1, LABELS), mine, INFO)
    refused(lambda: learn_goals(tmp_path / "mine", tmp_path / "a"), "no replay", "the folder of its run")
    with lock_folder(finished.run_dir):
        refused(lambda: resume_goals(finished.run_dir), "another process learns")
    refused(lambda: resume_goals(run), "holds a training run, not learned goals", "latentplan train --resume")
    unnamed = make_run(tmp_path / "unnamed", tiny(""), {})
    refused(lambda: learn_goals(unnamed, tmp_path / "b"), "without named quantities")
    assert not (tmp_path / "b").exists()
    other = make_run(tmp_path / "other", tiny("", env={"domain": "walker"}), LABELS)
    learn_goals(other, tmp_path / "c", GoalsConfig(**vars(SETTINGS) | {"updates": 1}))
    model, config, info = load_model(other)
    with torch.no_grad():
        model.actor.mlp.output.bias.add_(0.5)
    save_checkpoint(other / "checkpoints" / "last", model, config, INFO)
    refused(lambda: resume_goals(tmp_path / "c"), "not the agent")
    assert "goals" in read_info(tmp_path / "c")


def test_learn_goals_refuses_a_run_that_has_collected_nothing(run, tmp_path, monkeypatch):
    def load_nothing(save, model):
        return Replay(ROWS, 1, model.config.deter_dim, 1, torch.device("cpu"), len(model.labels))

    monkeypatch.setattr(goal_run, "load_replay", load_nothing)
    with pytest.raises(UserError, match="has collected nothing that goals could be learned from"):
        learn_goals(run, tmp_path / "out", SETTINGS)


@pytest.mark.parametrize(
    ("spaces", "words"),
    [(Spaces(vector_dim=2), "from pictures alone, without env.vectors"), (Spaces((3,)), "continuous actions only")],
)
def test_learn_goals_refuses_an_agent_that_cannot_learn_goals_before_it_plays(cartpole, tmp_path, spaces, words):
    config, labels = cartpole
    save_checkpoint(tmp_path / "agent", WorldModel(config.model, 1, labels, spaces=spaces), config, INFO)
    with pytest.raises(UserError, match=words):
        learn_goals(tmp_path / "agent", tmp_path / "out", SETTINGS)
    assert not (tmp_path / "out" / "replay").exists()


@pytest.fixture
def cartpole(tiny, monkeypatch):
    """Settings and quantities of a cartpole agent that plays short rounds."""
    monkeypatch.setattr(goal_run, "ROUND_DECISIONS", 25)
    env = {"domain": "cartpole", "task": "swingup", "action_repeat": 50, "render_quality": "fastest"}
    return tiny("", env=env), {quantity.name: quantity.scale for quantity in QUANTITIES["cartpole"]}


def test_learn_goals_plays_first_when_the_agent_has_no_replay(cartpole, tmp_path):
    config, labels = cartpole
    model = WorldModel(config.model, 1, labels)
    save_checkpoint(tmp_path / "agent", model, config, INFO | {"domain": "cartpole", "task": "swingup"})
    settings = GoalsConfig(**vars(SETTINGS) | {"updates": 1, "play_decisions": 50})
    learn_goals(tmp_path / "agent", tmp_path / "out", settings)
    replay = load_replay(Saves(tmp_path / "out" / "replay", "replay", 1).newest()[0], model)
    assert 50 <= len(replay) <= 55 and float(replay.labels.abs().sum()) > 0.0
    resumed = resume_goals(tmp_path / "out", updates=2)
    assert read_info(resumed.run_dir)["goals"]["updates"] == 2


def test_learn_goals_reuses_a_played_replay_only_of_the_same_agent(cartpole, tmp_path, capsys):
    config, labels = cartpole
    settings = GoalsConfig(**vars(SETTINGS) | {"updates": 1, "play_decisions": 25})

    def learn(agent):
        torch.manual_seed(agent)
        folder = tmp_path / f"agent{agent}"
        save_checkpoint(folder, WorldModel(config.model, 1, labels), config, INFO | {"domain": "cartpole"})
        learn_goals(folder, tmp_path / "out", settings)
        (tmp_path / "out" / "info.json").unlink()  # as if the process had ended before its first save
        shutil.rmtree(tmp_path / "out" / "resume")
        save = Saves(tmp_path / "out" / "replay", "replay", 1).newest()[0]
        return "playing 25 decisions" in capsys.readouterr().out, (save.folder / "rows.pt").read_bytes()

    first, again, other = learn(0), learn(0), learn(1)
    assert first[0] and not again[0] and other[0]
    assert first[1] == again[1] != other[1]


def test_describe_box_returns_an_expression_that_parses_to_the_box():
    names, inf = ("height", "speed", "upright"), math.inf
    text = describe_box(names, (-inf, 1.0, 0.2), (inf, 1.0, 0.5))
    box = box_of(parse_objective(text, {name: 1.0 for name in names}), names)
    assert box == {"speed": (1.0, 1.0), "upright": (0.2, 0.5)}
