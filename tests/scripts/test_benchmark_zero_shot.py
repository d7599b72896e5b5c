"""Goals that an agent was not trained for, measured with every player."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import Config, EnvConfig, ModelConfig, PlannerConfig
from latentplan.config.quantities import scales
from latentplan.models import WorldModel

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))

import benchmark  # noqa: E402
from bench.zero_shot import CONSTRAINT_PLAYERS, OBJECTIVE_PLAYERS, PURSUERS, Request, list_jobs  # noqa: E402

ENV = EnvConfig(domain="cartpole", task="swingup", action_repeat=200, render_quality="fastest")
MODEL = ModelConfig(deter_dim=8, hidden_dim=8, encoder_channels=(4, 4), decoder_channels=2, num_bins=5)
PLANNER = PlannerConfig(horizon=3, num_samples=8, num_elites=2, num_policy_samples=1, num_iterations=2)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """An untrained agent for five-decision episodes of cartpole."""
    return saved(tmp_path_factory.mktemp("agent"), ENV)


def saved(folder, env):
    info = {"domain": "cartpole", "task": "swingup", "env_frames": 1234, "discount": 0.9, "metrics": {}}
    torch.manual_seed(0)
    model = WorldModel(MODEL, 1, scales("cartpole"))
    save_checkpoint(folder, model, Config(env=env, model=MODEL, planner=PLANNER), info)
    return folder


def test_every_goal_is_measured_with_every_player(tmp_path, checkpoint, capsys):
    path = tmp_path / "result.json"
    flags = ["--objectives", "cart -> 1.0", "--constraints", "cart < 0.01", "--episodes", "2", "--json", str(path)]
    flags += ["--planner.horizon", "2", "--device", "cpu"]
    assert benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), *flags]) == 0
    result = json.loads(path.read_text())
    found = [(row["goal"], row["kind"], row["player"]) for row in result["rows"]]
    assert found == [
        *(("cart -> 1.0", "objective", player) for player in OBJECTIVE_PLAYERS),
        *(("cart < 0.01", "constraint", player) for player in CONSTRAINT_PLAYERS),
    ]
    by_player = {(row["kind"], row["player"]): row for row in result["rows"]}
    assert all(0.0 <= rate <= 1.0 for rate in by_player["constraint", "planner"]["scores"])
    assert all(row["ci95"][0] <= row["mean"] <= row["ci95"][1] for row in result["rows"])
    # Who does not know of the goal plays the same whatever is scored.
    for player in ("actor", "random"):
        assert by_player["objective", player]["returns"] == by_player["constraint", player]["returns"]
    assert result["planner"]["horizon"] == 2 and result["planner"]["goal_horizon"] is None  # as played
    assert "cart < 0.01 (constraint)" in capsys.readouterr().out


def test_some_players_are_compared_with_an_agent_trained_for_the_goal(tmp_path, checkpoint):
    path = tmp_path / "result.json"
    flags = ["--objectives", "cart -> 1.0", "--players", "random, actor", "--trained", str(checkpoint)]
    flags += ["--episodes", "2", "--json", str(path), "--device", "cpu"]
    assert benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), *flags]) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["player"] for row in rows] == ["actor", "random", "trained planner", "trained actor"]
    by_player = {row["player"]: row for row in rows}
    assert by_player["trained actor"]["scores"] == by_player["actor"]["scores"]  # the same agent here
    assert 1000.0 * by_player["actor"]["quantities"]["task.swingup"] == pytest.approx(by_player["actor"]["mean_return"])


def test_what_is_trained_for_a_constraint_is_paid_by_the_task_too(tmp_path, checkpoint):
    trained = saved(tmp_path / "trained", replace(ENV, task="balance", objective="cart > 100"))  # which pays nothing
    path = tmp_path / "result.json"
    flags = ["--constraints", "cart < 0.01", "--players", "actor", "--trained", str(trained), "--json", str(path)]
    assert (
        benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), "--episodes", "2", "--device", "cpu", *flags])
        == 0
    )
    result = json.loads(path.read_text())
    actor, _, same = result["rows"]
    assert [row["player"] for row in result["rows"]] == ["actor", "trained planner", "trained actor"]
    assert same["returns"] == actor["returns"] != [0.0, 0.0] and same["scores"] == actor["scores"]
    assert result["floor"] == "endless"


def test_kicks_are_the_same_for_every_player_and_change_what_they_earn(checkpoint):
    from bench.zero_shot import Conditions, Job, play_job

    def play(player, push, *seeds):
        return play_job(Conditions(str(checkpoint), seeds, "cpu", {}, push), Job("cart -> 1.0", None, player))["scores"]

    calm, pushed = play("actor", 0.0, *range(20)), play("actor", 3.0, *range(20))
    changed = [before != after for before, after in zip(calm, pushed, strict=True)]
    assert 0 < sum(changed) < 15  # five decisions per episode, one in 25 of them with a kick
    assert play("actor", 3.0, *range(20)) == pushed
    kicked = changed.index(True)
    assert play("random", 0.0, kicked) != play("random", 3.0, kicked)
    calm_seed = changed.index(False)
    assert play("random", 0.0, calm_seed) == play("random", 3.0, calm_seed)


def test_the_plain_gate_acts_by_its_actor_wherever_it_does_not_plan(checkpoint):
    from bench.players import make_player

    frames = torch.randint(0, 256, (12, 64, 64, 3), dtype=torch.uint8).numpy()
    sources = {}
    for player in ("random gate", "random moments"):
        agent = make_player(player, str(checkpoint), "cpu", {"horizon": 2})
        agent.set_objective("cart -> 1.0")
        sources[player] = []
        for frame in frames:
            agent.act(frame)
            sources[player].append(agent.last_source)
    assert set(sources["random gate"]) == {"plan", "actor"}
    assert set(sources["random moments"]) == {"plan", "tail"}


def test_list_jobs_lists_each_goal_once_in_order():
    jobs = list_jobs(Request(checkpoint=Path("agent"), objectives="cart > 1; 500: cart < 1 | upright | upright |"))
    assert [job.objective for job in jobs[:: len(OBJECTIVE_PLAYERS)]] == ["cart > 1; 500: cart < 1", "upright"]


@pytest.mark.parametrize(
    ("flags", "reason"),
    [
        ((), "give --objectives"),
        (("--objectives", "crat > 1"), "Did you mean 'cart'"),
        (("--constraints", "cart"), "ineq"),
        (("--objectives", "cart > 1", "--players", "planer"), "'planner'"),
        (("--objectives", "cart > 1", "--players", "unconstrained"), "nobody"),
        (("--objectives", "cart > 1", "--trained", "nowhere"), "nowhere"),
    ],
)
def test_zero_shot_refuses_bad_goals_in_one_line(capsys, checkpoint, flags, reason):
    assert benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), *flags]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and reason in error


def test_all_who_pursue_a_goal_search_alike(checkpoint):
    from bench.players import make_player

    changes = {"horizon": 2}
    searches = [make_player(player, str(checkpoint), "cpu", changes).controller.planner for player in PURSUERS]
    assert {(search.horizon, search.goal_horizon) for search in searches} == {(2, None)}
