"""Distillation: the actor comes to do what the planner does, and nothing else changes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, load_model, read_info, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import DistillConfig, PlannerConfig, UserError
from latentplan.models import Gaussian, State, WorldModel
from latentplan.training import distill, resume_distillation
from latentplan.training.distillation.comparison import Comparison
from latentplan.training.distillation.labels import Demonstrations, plan_actions
from latentplan.training.distillation.standing import STATE_FILE
from latentplan.training.distillation.student import Student
from latentplan.training.folder import claim
from latentplan.training.state import INTERRUPTED

INFO = {"domain": "user", "task": "push", "env_frames": 7, "discount": 0.9, "metrics": [{"planner": 1.0}]}
PLANNER = PlannerConfig(
    horizon=2, num_samples=128, num_elites=16, num_iterations=3, num_policy_samples=2, terminal_value=False
)
SETTINGS = DistillConfig(rounds=3, episodes=2, updates=60, evaluation_episodes=8, plan_batch=16, learning_rate=3e-3)


@pytest.fixture(scope="session")
def push(dot):
    """An environment that pays for pushing to the right, which is where the untrained planner below pushes."""

    class Push(dot):
        def step(self, action):
            picture, _, terminated, truncated, info = super().step(action)
            return picture, float(action[0]), terminated, truncated, info

    return Push


@pytest.fixture(scope="session")
def model(tiny):
    """A world that rewards the push to the right, and an actor that does nothing."""
    torch.manual_seed(0)
    model = WorldModel(tiny("").model, action_dim=1)
    with torch.no_grad():
        model.reward_head.mlp.output.weight.normal_(std=1.0)
        model.dynamics.input.linear.weight[:, -1] *= 4.0
        for parameter in model.parameters():
            parameter.copy_(parameter.half().float())
    return model.eval()


@pytest.fixture(scope="session")
def checkpoint(model, tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    save_checkpoint(folder, model, tiny("", planner=vars(PLANNER)), INFO)
    return folder


@pytest.fixture(scope="session")
def finished(checkpoint, push, tmp_path_factory):
    return distill(checkpoint, tmp_path_factory.mktemp("runs") / "out", SETTINGS, make_env=push)


def weights_of(folder):
    return load_model(folder)[0].state_dict()


def states_of(model, rows=40, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return State(
        0.5 * torch.randn(rows, model.config.deter_dim, generator=generator),
        torch.randn(rows, model.config.latent_dim, generator=generator),
    )


def test_an_untrained_actor_recovers_most_of_the_planners_return(finished):
    before, after, planner = (finished.summary[name] for name in ("before", "after", "planner"))
    assert finished.exit_code == 0 and planner > before + 3.0
    assert after > before + 0.75 * (planner - before)


def test_only_the_actor_changes(finished, checkpoint):
    before, after = weights_of(checkpoint), weights_of(finished.run_dir)
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"actor"}


def test_the_result_is_a_checkpoint_that_keeps_what_was_known(finished, checkpoint):
    info, start = read_info(finished.run_dir), read_info(checkpoint)
    assert {name: info[name] for name in INFO} == INFO and info["config"] == start["config"]
    distilled = info["distilled"]
    assert (distilled["rounds"], distilled["decisions"]) == (3, 3 * 2 * 20)
    assert distilled["kept_round"] in (1, 2, 3) and distilled["from_sha256"] == start["sha256"]
    assert np.mean(distilled["returns_after"]) == finished.summary["after"]
    assert np.mean(distilled["returns_before"]) == finished.summary["before"]
    assert np.mean(distilled["returns_planner_after"]) == finished.summary["planner_after"]
    assert load_agent(finished.run_dir, mode="actor").act(np.zeros((64, 64, 3), np.uint8)).shape == (1,)


def test_what_is_reported_is_what_the_saved_actor_earns(finished, push):
    from latentplan.config import EnvConfig, derive_seed
    from latentplan.envs import make_from
    from latentplan.evaluation.episodes import episode_seed, run_episodes

    env = make_from(push)(EnvConfig(action_repeat=1), 0)
    seeds = [episode_seed(derive_seed(0, "judge"), index) for index in range(SETTINGS.evaluation_episodes)]
    episodes = run_episodes(env, load_agent(finished.run_dir, mode="actor"), seeds)
    returns = read_info(finished.run_dir)["distilled"]["returns_after"]
    assert [episode.total_return for episode in episodes] == pytest.approx(returns)


def test_an_actor_that_earns_more_than_its_planner_is_kept(checkpoint, push, tmp_path, capsys):
    class Pull(push):
        def step(self, action):
            picture, reward, *rest = super().step(action)
            return picture, -reward, *rest

    result = distill(checkpoint, tmp_path / "out", SETTINGS, make_env=Pull)
    assert result.summary["planner"] < result.summary["before"] == result.summary["after"]
    before, after = weights_of(checkpoint), weights_of(tmp_path / "out")
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert read_info(tmp_path / "out")["distilled"]["kept_round"] is None
    out = capsys.readouterr().out
    assert "an improvement is not to be expected" in out and "that actor is kept, unchanged" in out


# Steps: 6 episodes of 20 to begin with; then in each round 2 driven and 2 judged.
@pytest.mark.parametrize("at_step", [50, 180])
def test_an_interrupted_distillation_ends_as_if_nothing_had_happened(
    at_step, finished, checkpoint, push, tmp_path, capsys, interrupting
):
    out = tmp_path / "out"
    stopped = distill(checkpoint, out, SETTINGS, make_env=interrupting(push, at_step).make)
    assert (stopped.exit_code, dict(stopped.summary)) == (INTERRUPTED, {})
    assert f"--resume {out}" in " ".join(capsys.readouterr().out.split())
    gone_on = resume_distillation(out, make_env=push)
    assert gone_on.exit_code == 0 and gone_on.summary == finished.summary
    expected, after = weights_of(finished.run_dir), weights_of(out)
    assert all(torch.equal(expected[name], after[name]) for name in expected)
    saved, reference = (torch.load(folder / STATE_FILE, weights_only=True) for folder in (out, finished.run_dir))
    assert saved["standing"]["stage"] == reference["standing"]["stage"] == 9
    assert all(torch.equal(saved["demonstrations"][name], part) for name, part in reference["demonstrations"].items())


def test_in_an_environment_of_ones_own_it_goes_on_from_python(model, tiny, push, tmp_path, capsys, interrupting):
    save_checkpoint(tmp_path / "mine", model, tiny("", env={"domain": "user"}, planner=vars(PLANNER)), INFO)
    distill(tmp_path / "mine", tmp_path / "out", SETTINGS, make_env=interrupting(push, 5).make)
    assert f'resume_distillation("{tmp_path / "out"}", make_env=...)' in "".join(capsys.readouterr().out.split("\n"))


def test_more_rounds_may_follow(checkpoint, push, tmp_path):
    small = DistillConfig(rounds=1, episodes=1, updates=5, evaluation_episodes=2)
    distill(checkpoint, tmp_path / "out", small, make_env=push)
    resume_distillation(tmp_path / "out", rounds=2, make_env=push)
    assert read_info(tmp_path / "out")["distilled"]["rounds"] == 2


def test_no_round_begins_after_the_minutes_are_spent(checkpoint, push, tmp_path):
    small = DistillConfig(minutes=1e-9, episodes=1, updates=5, evaluation_episodes=2)
    assert distill(checkpoint, tmp_path / "out", small, make_env=push).exit_code == 0
    assert read_info(tmp_path / "out")["distilled"]["rounds"] == 0


def test_folders_that_do_not_fit_are_refused(finished, checkpoint, push, tmp_path):
    with pytest.raises(UserError, match="--resume"):
        distill(checkpoint, finished.run_dir, SETTINGS, make_env=push)
    with pytest.raises(UserError, match="already holds an agent: choose another --out"):
        distill(checkpoint, checkpoint, SETTINGS, make_env=push)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").touch()
    with pytest.raises(UserError, match="already holds a run: choose another --out"):
        distill(checkpoint, tmp_path / "run", SETTINGS, make_env=push)
    with pytest.raises(UserError, match="nothing to resume"):
        resume_distillation(tmp_path)
    with claim(tmp_path / "held"), pytest.raises(UserError, match="another process learns"):
        distill(checkpoint, tmp_path / "held", SETTINGS, make_env=push)
    (tmp_path / "resume").mkdir()
    (tmp_path / "resume" / "distill.pt").write_bytes((finished.run_dir / "resume" / "distill.pt").read_bytes()[:-100])
    with pytest.raises(UserError, match=r"distill\.pt is damaged"):
        resume_distillation(tmp_path)


def test_an_agent_whose_goals_build_on_its_actor_is_refused(model, tiny, push, tmp_path):
    knows_goals = WorldModel(tiny("").model, action_dim=1, labels={"speed": 1.0}, goal_dim=8)
    save_checkpoint(tmp_path / "agent", knows_goals, tiny(""), INFO)
    with pytest.raises(UserError, match="distill before"):
        distill(tmp_path / "agent", tmp_path / "out", SETTINGS, make_env=push)


def test_a_deadline_of_the_search_is_lifted(checkpoint, push, tmp_path):
    small = DistillConfig(rounds=1, episodes=1, updates=5, evaluation_episodes=2)
    hurried = replace(PLANNER, deadline_ms=1e-6)
    assert distill(checkpoint, tmp_path / "out", small, planner=hurried, make_env=push).exit_code == 0
    assert read_info(tmp_path / "out")["distilled"]["planner"]["deadline_ms"] is None


def test_old_labels_are_planned_again_in_each_round(finished):
    rounds = torch.load(finished.run_dir / STATE_FILE, weights_only=True)["demonstrations"]["round"]
    # 40 beliefs a round; a tenth of the 40 and of the 80 there were before is labelled anew in rounds 1 and 2.
    assert len(rounds) == 120
    assert rounds[:40].unique(return_counts=True)[1].tolist() == [40 - 12, 4, 8]


def test_the_planner_leaves_its_first_action_behind(model, tiny):
    agent = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER)
    action = agent.act(np.full((3, 64, 64, 3), 9, np.uint8))
    mean, std = agent.controller.plan.action_distribution(PLANNER.min_std)
    assert np.allclose(mean.numpy(), action) and std.shape == (3, 1)
    assert torch.equal(std, agent.controller.plan.var[:, 0].sqrt().clamp_min(PLANNER.min_std))


def test_labels_are_plans_whatever_the_batch(model, tiny):
    planner, states = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER).controller.planner, states_of(model)
    done = []
    whole, parts = (
        plan_actions(planner, model, states, torch.Generator().manual_seed(0), rows, done.append) for rows in (40, 7)
    )
    assert done == [40, 7, 14, 21, 28, 35, 40]
    assert whole.mean.shape == whole.std.shape == (40, 1) and float(whole.std.min()) >= PLANNER.min_std
    assert torch.allclose(parts.mean[:7], whole.mean[:7], atol=1e-3)
    assert (parts.mean - whole.mean).abs().mean() < 0.3  # other noise, the same reward


def test_beliefs_without_a_finite_plan_are_an_error(model, tiny):
    planner, states = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER).controller.planner, states_of(model)
    states.deter[3] = float("nan")
    with pytest.raises(FloatingPointError, match="at 1 of 40 states"):
        plan_actions(planner, model, states, torch.Generator(), 40, lambda done: None)


def test_a_student_learns_what_is_demonstrated(model):
    states = states_of(model, 300)
    wanted = Gaussian(torch.tanh(states.deter[:, :1]), torch.full((300, 1), 0.3))
    demonstrations, losses = Demonstrations(), []
    demonstrations.add(states, wanted, 0)
    student = Student(model.actor, DistillConfig(updates=200, learning_rate=3e-3))
    assert student.learn(demonstrations, 0, lambda done, loss: losses.append(loss)) == pytest.approx(np.mean(losses))
    assert len(losses) == 200 and losses[-1] < 0.2 * losses[0]
    mean, std = (part.detach() for part in student.actor(states.features))
    assert (mean - wanted.mean).abs().mean() < 0.15 and float(std.mean()) == pytest.approx(0.3, abs=0.1)


def test_a_student_of_turned_beliefs_learns_the_same_from_every_side(model):
    demonstrations, rows = Demonstrations(), states_of(model, 160)
    sides = State(*(part.unflatten(0, (40, 4)) for part in rows))
    planned = Gaussian(torch.linspace(-0.8, 0.8, 40)[:, None], torch.full((40, 1), 0.1))
    demonstrations.add(sides, planned, 0)
    student = Student(model.actor, DistillConfig(updates=400, learning_rate=3e-3, batch_size=40))
    student.learn(demonstrations, 0, lambda done, loss: None)
    with torch.no_grad():
        mean = student.actor(sides.features)[0]
    assert (mean - planned.mean[:, None]).abs().mean() < 0.1


def test_labels_that_are_not_finite_stop_learning(model):
    demonstrations = Demonstrations()
    demonstrations.add(states_of(model), Gaussian(torch.full((40, 1), float("nan")), torch.ones(40, 1)), 0)
    with pytest.raises(FloatingPointError, match="not finite"):
        Student(model.actor, DistillConfig()).learn(demonstrations, 0, lambda done, loss: None)


@pytest.mark.parametrize(
    ("after", "planner_after", "words"),
    [
        (None, None, ["no round improved", "unchanged"]),
        ([5.0, 6.0, 7.0], [25.0, 20.0, 21.0], ["but not here", "unchanged", "-5.0"]),
        ([15.0, 16.0, 18.0], [20.0, 19.0, 21.0], ["kept: the actor of round 4"]),
        ([9.0, 12.0, 16.0], [20.0, 20.0, 21.0], ["kept: the actor of round 4", "holds 0"]),
        ([15.0, 16.0, 18.0], [10.0, 10.0, 21.0], ["loses more", "unchanged", "+5.3", "-6.7"]),
    ],
)
def test_the_verdict_follows_from_paired_returns(after, planner_after, words):
    found = Comparison([10.0, 11.0, 12.0], [20.0, 20.0, 21.0], after, planner_after)
    text = "\n".join(found.describe(4))
    assert all(word in text for word in words), text
    assert ("holds 0" in text) == ("holds 0" in words)
    assert found.is_better == ("kept: the actor of round 4" in words)
