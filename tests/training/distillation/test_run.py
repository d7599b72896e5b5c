"""Distillation: the actor learns to act as the planner, and nothing else changes."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, load_model, read_info, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import DistillConfig, EnvironmentFault, PlannerConfig, UserError
from latentplan.config.commit import Saves
from latentplan.config.earlier import ADDED
from latentplan.config.run_folder import lock_folder
from latentplan.models import Gaussian, State, WorldModel
from latentplan.training import distill, resume_distillation
from latentplan.training.distillation.labels import Demonstrations, plan_actions
from latentplan.training.distillation.run import Comparison
from latentplan.training.distillation.saves import FORMAT, KIND
from latentplan.training.distillation.student import Student
from latentplan.training.state import save_values
from tests.training.run_folder import list_saves, read_state

INFO = {"domain": "user", "task": "push", "env_frames": 7, "discount": 0.9, "metrics": [{"planner": 1.0}]}
PLANNER = PlannerConfig(
    horizon=2, num_samples=128, num_elites=16, num_iterations=3, num_policy_samples=2, terminal_value=False
)
SETTINGS = DistillConfig(rounds=3, episodes=2, updates=60, evaluation_episodes=4, plan_batch=16, learning_rate=3e-3)
SHORT = DistillConfig(rounds=1, episodes=1, updates=5, evaluation_episodes=2)


@pytest.fixture(scope="session")
def push(dot):
    """An environment that rewards pushing to the right, as the untrained world model below predicts."""

    class Push(dot):
        def step(self, action):
            picture, _, terminated, truncated, info = super().step(action)
            return picture, float(action[0]), terminated, truncated, info

    return Push


def make_model(tiny, seed):
    torch.manual_seed(seed)
    model = WorldModel(tiny("").model, action_dim=1)
    with torch.no_grad():
        model.reward_head.mlp.output.weight.normal_(std=1.0)
        model.dynamics.input.linear.weight[:, -1] *= 4.0
        for parameter in model.parameters():
            parameter.copy_(parameter.half().float())
    return model.eval()


def pushing_right_pays(model):
    """Share of states in which the model predicts more reward for the largest action than for any other."""
    states, actions = draw_states(model), torch.linspace(-1.0, 1.0, 9)
    with torch.no_grad():
        rewards = [model.step(states, action.expand(len(states.deter), 1))[1] for action in actions]
    return (torch.stack(rewards).argmax(0) == len(actions) - 1).float().mean().item()


@pytest.fixture(scope="session")
def model(tiny):
    """An untrained world model that predicts reward for pushing to the right, and an actor that stays at zero."""
    return max((make_model(tiny, seed) for seed in range(20)), key=pushing_right_pays)


@pytest.fixture(scope="session")
def checkpoint(model, tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("start")
    save_checkpoint(folder, model, tiny("", planner=vars(PLANNER)), INFO)
    return folder


@pytest.fixture(scope="session")
def finished(checkpoint, push, tmp_path_factory):
    return distill(checkpoint, tmp_path_factory.mktemp("runs") / "out", SETTINGS, make_env=push)


def read_weights(folder):
    return load_model(folder)[0].state_dict()


def draw_states(model, rows=40, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return State(
        0.5 * torch.randn(rows, model.config.deter_dim, generator=generator),
        torch.randn(rows, model.config.latent_dim, generator=generator),
    )


def test_distill_recovers_most_of_the_planners_return(finished):
    before, after, planner = (finished.summary[name] for name in ("before", "after", "planner"))
    assert finished.exit_code == 0 and planner > before + 3.0
    assert after > before + 0.75 * (planner - before)


def test_distill_changes_only_the_actor(finished, checkpoint):
    before, after = read_weights(checkpoint), read_weights(finished.run_dir)
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"actor"}


def test_distill_saves_a_checkpoint_with_the_facts_of_the_agent(finished, checkpoint):
    info, start = read_info(finished.run_dir), read_info(checkpoint)
    assert {name: info[name] for name in INFO} == INFO and info["config"] == start["config"]
    distilled = info["distilled"]
    assert (distilled["rounds"], distilled["decisions"]) == (3, 3 * 2 * 20)
    assert distilled["kept_round"] in (1, 2, 3) and distilled["from_sha256"] == start["sha256"]
    assert np.mean(distilled["returns_after"]) == finished.summary["after"]
    assert np.mean(distilled["returns_before"]) == finished.summary["before"]
    assert np.mean(distilled["returns_planner_after"]) == finished.summary["planner_after"]
    assert load_agent(finished.run_dir, mode="actor").act(np.zeros((64, 64, 3), np.uint8)).shape == (1,)


def test_distill_reports_the_returns_of_the_saved_actor(finished, push):
    from latentplan.config import EnvConfig, derive_seed
    from latentplan.envs import make_from
    from latentplan.evaluation.episodes import episode_seed, run_episodes

    env = make_from(push)(EnvConfig(action_repeat=1), 0)
    seeds = [episode_seed(derive_seed(0, "judge"), index) for index in range(SETTINGS.evaluation_episodes)]
    episodes = run_episodes(env, load_agent(finished.run_dir, mode="actor"), seeds)
    returns = read_info(finished.run_dir)["distilled"]["returns_after"]
    assert [episode.total_return for episode in episodes] == pytest.approx(returns)


def test_distill_keeps_an_actor_that_earns_more_than_its_planner(checkpoint, push, tmp_path, capsys):
    class Pull(push):
        def step(self, action):
            picture, reward, *rest = super().step(action)
            return picture, -reward, *rest

    result = distill(checkpoint, tmp_path / "out", SHORT, make_env=Pull)
    assert result.summary["planner"] < result.summary["before"] == result.summary["after"]
    before, after = read_weights(checkpoint), read_weights(tmp_path / "out")
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert read_info(tmp_path / "out")["distilled"]["kept_round"] is None
    out = " ".join(capsys.readouterr().out.split())
    assert "an improvement is not to be expected" in out and "the actor before is kept, unchanged" in out


# Steps: 12 episodes of 20 before the first round; then in each round 2 collected and 4 selection episodes.
@pytest.mark.parametrize("at_step", [50, 300])
def test_resume_distillation_ends_with_the_agent_of_an_uninterrupted_one(
    at_step, finished, checkpoint, push, tmp_path, capsys, interrupting
):
    out = tmp_path / "out"
    stopped = distill(checkpoint, out, SETTINGS, make_env=interrupting(push, at_step).make)
    assert (stopped.exit_code, dict(stopped.summary)) == (130, {})
    assert f"--resume {out}" in " ".join(capsys.readouterr().out.split())
    gone_on = resume_distillation(out, make_env=push)
    assert gone_on.exit_code == 0 and gone_on.summary == finished.summary
    expected, after = read_weights(finished.run_dir), read_weights(out)
    assert all(torch.equal(expected[name], after[name]) for name in expected)
    saved, reference = (read_state(folder) for folder in (out, finished.run_dir))
    assert saved["state"]["stage"] == reference["state"]["stage"] == 9
    assert all(torch.equal(saved["demonstrations"][name], part) for name, part in reference["demonstrations"].items())


def test_distill_names_the_python_call_that_resumes_in_the_users_environment(
    model, tiny, push, tmp_path, capsys, interrupting
):
    save_checkpoint(tmp_path / "mine", model, tiny("", env={"domain": "user"}, planner=vars(PLANNER)), INFO)
    distill(tmp_path / "mine", tmp_path / "out", SETTINGS, make_env=interrupting(push, 5).make)
    assert f'resume_distillation("{tmp_path / "out"}", make_env=...)' in "".join(capsys.readouterr().out.split("\n"))


@pytest.fixture(scope="session")
def spent(checkpoint, push, tmp_path_factory):
    """A distillation whose minutes were spent before its first round, and whose search had a deadline."""
    out, hurried = tmp_path_factory.mktemp("spent") / "out", replace(PLANNER, deadline_ms=1e-6)
    return distill(checkpoint, out, replace(SHORT, minutes=1e-9), planner=hurried, make_env=push)


def test_distill_begins_no_round_after_its_minutes(spent):
    assert spent.exit_code == 0 and read_info(spent.run_dir)["distilled"]["rounds"] == 0


def test_distill_lifts_the_deadline_of_the_search(spent):
    assert read_info(spent.run_dir)["distilled"]["planner"]["deadline_ms"] is None


def test_resume_distillation_adds_rounds(spent, push, tmp_path):
    folder = shutil.copytree(spent.run_dir, tmp_path / "out")
    resume_distillation(folder, rounds=2, minutes=60.0, make_env=push)
    assert read_info(folder)["distilled"]["rounds"] == 2


def test_resume_distillation_searches_as_the_earlier_version_that_saved_it(spent, push, tmp_path):
    folder = shutil.copytree(spent.run_dir, tmp_path / "out")
    saved = read_state(folder)
    saved["planner"] = {name: value for name, value in saved["planner"].items() if name not in ADDED["planner"]}
    save_values(Saves(folder / "resume", KIND, FORMAT), saved, {})
    resume_distillation(folder, make_env=push)
    searched = read_info(folder)["distilled"]["planner"]
    assert {name: searched[name] for name in ADDED["planner"]} == ADDED["planner"]


def test_resume_distillation_goes_back_to_the_save_before_a_damaged_one(finished, push, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "out")
    path = list_saves(folder)[-1] / "state.pt"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.warns(RuntimeWarning, match=r"state\.pt is damaged.*the save before takes its place"):
        again = resume_distillation(folder, make_env=push)
    assert again.summary == finished.summary


def test_distill_refuses_folders_in_use_or_damaged(finished, checkpoint, push, tmp_path):
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
    with lock_folder(tmp_path / "held"), pytest.raises(UserError, match="another process learns"):
        distill(checkpoint, tmp_path / "held", SETTINGS, make_env=push)
    (tmp_path / "resume").mkdir()
    (tmp_path / "resume" / "distill.pt").touch()
    with pytest.raises(UserError, match="0.2.0 or earlier"):
        resume_distillation(tmp_path)


def test_distill_refuses_an_agent_with_learned_goals(model, tiny, push, tmp_path):
    knows_goals = WorldModel(tiny("").model, action_dim=1, labels={"speed": 1.0}, goal_dim=8)
    save_checkpoint(tmp_path / "agent", knows_goals, tiny(""), INFO)
    with pytest.raises(UserError, match=r"distill\.py before"):
        distill(tmp_path / "agent", tmp_path / "out", SETTINGS, make_env=push)


def test_distill_plans_the_oldest_labels_again_in_each_round(finished):
    rounds = read_state(finished.run_dir)["demonstrations"]["round"]
    # 40 beliefs a round; a tenth of the 40 and of the 80 there were before is labelled anew in rounds 1 and 2.
    assert len(rounds) == 120
    assert rounds[:40].unique(return_counts=True)[1].tolist() == [40 - 12, 4, 8]


def test_plan_gives_the_distribution_of_the_first_action(model, tiny):
    agent = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER)
    action = agent.act(np.full((3, 64, 64, 3), 9, np.uint8))
    mean, std = agent.controller.plan.action_distribution(PLANNER.min_std)
    assert np.allclose(mean.numpy(), action) and std.shape == (3, 1)
    assert torch.equal(std, agent.controller.plan.var[:, 0].sqrt().clamp_min(PLANNER.min_std))


def test_plan_actions_returns_the_same_labels_for_any_batch_size(model, tiny):
    planner, states = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER).controller.planner, draw_states(model)
    done = []
    whole, parts = (
        plan_actions(planner, model, states, torch.Generator().manual_seed(0), rows, done.append) for rows in (40, 7)
    )
    assert done == [40, 7, 14, 21, 28, 35, 40]
    assert whole.mean.shape == whole.std.shape == (40, 1) and float(whole.std.min()) >= PLANNER.min_std
    assert torch.allclose(parts.mean[:7], whole.mean[:7], atol=1e-3)
    assert (parts.mean - whole.mean).abs().mean() < 0.3  # other noise, the same reward


def test_plan_actions_raises_when_a_search_finds_no_finite_return(model, tiny):
    planner, states = PlanningAgent(model, tiny(""), 0.9, planner=PLANNER).controller.planner, draw_states(model)
    states.deter[3] = float("nan")
    with pytest.raises(FloatingPointError, match="at 1 of 40 states"):
        plan_actions(planner, model, states, torch.Generator(), 40, lambda done: None)


def test_student_learns_the_labels(model):
    states = draw_states(model, 300)
    wanted = Gaussian(torch.tanh(states.deter[:, :1]), torch.full((300, 1), 0.3))
    demonstrations, losses = Demonstrations(), []
    demonstrations.add(states, wanted, 0)
    student = Student(model.actor, DistillConfig(updates=200, learning_rate=3e-3))
    assert student.learn(demonstrations, 0, lambda done, loss: losses.append(loss)) == pytest.approx(np.mean(losses))
    assert len(losses) == 200 and losses[-1] < 0.2 * losses[0]
    mean, std = (part.detach() for part in student.actor(states.features))
    assert (mean - wanted.mean).abs().mean() < 0.15 and float(std.mean()) == pytest.approx(0.3, abs=0.1)


def test_student_learns_one_label_for_all_turns_of_a_belief(model):
    demonstrations, rows = Demonstrations(), draw_states(model, 160)
    sides = State(*(part.unflatten(0, (40, 4)) for part in rows))
    planned = Gaussian(torch.linspace(-0.8, 0.8, 40)[:, None], torch.full((40, 1), 0.1))
    demonstrations.add(sides, planned, 0)
    student = Student(model.actor, DistillConfig(updates=400, learning_rate=3e-3, batch_size=40))
    student.learn(demonstrations, 0, lambda done, loss: None)
    with torch.no_grad():
        mean = student.actor(sides.features)[0]
    assert (mean - planned.mean[:, None]).abs().mean() < 0.1


def test_student_raises_when_labels_are_not_finite(model):
    demonstrations = Demonstrations()
    demonstrations.add(draw_states(model), Gaussian(torch.full((40, 1), float("nan")), torch.ones(40, 1)), 0)
    with pytest.raises(FloatingPointError, match="not finite"):
        Student(model.actor, DistillConfig()).learn(demonstrations, 0, lambda done, loss: None)


@pytest.mark.parametrize(
    ("after", "planner_after", "words"),
    [
        (None, None, ["no round improved", "unchanged"]),
        ([5.0, 6.0, 7.0], [25.0, 20.0, 21.0], ["but not on the test starts", "unchanged", "-5.0"]),
        ([15.0, 16.0, 18.0], [20.0, 19.0, 21.0], ["kept: the actor of round 4"]),
        ([9.0, 12.0, 16.0], [20.0, 20.0, 21.0], ["kept: the actor of round 4", "contains 0"]),
        ([15.0, 16.0, 18.0], [10.0, 10.0, 21.0], ["loses more", "unchanged", "+5.3", "-6.7"]),
    ],
)
def test_comparison_keeps_the_actor_that_gains_more_than_the_planner_loses(after, planner_after, words):
    found = Comparison([10.0, 11.0, 12.0], [20.0, 20.0, 21.0], after, planner_after)
    text = "\n".join(found.describe(4))
    assert all(word in text for word in words), text
    assert ("contains 0" in text) == ("contains 0" in words)
    assert found.is_better == ("kept: the actor of round 4" in words)


def test_environment_that_fails_while_an_agent_is_distilled_is_a_fault_of_its_own(checkpoint, dot, tmp_path):
    class Failing(dot):
        def step(self, action):
            raise ZeroDivisionError("the dot is lost")

    with pytest.raises(EnvironmentFault, match="raised ZeroDivisionError: the dot is lost"):
        distill(checkpoint, tmp_path / "out", make_env=Failing)
