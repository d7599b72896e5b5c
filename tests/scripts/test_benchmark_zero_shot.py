"""`benchmark.py zero-shot`: goals that the agent was not trained for, played by every player."""

import json
from pathlib import Path

import benchmark
import numpy as np
import pytest
import torch
from bench.zero_shot import (
    CONSTRAINT_PLAYERS,
    OBJECTIVE_PLAYERS,
    PLANNING_PLAYERS,
    PUSH_PROBABILITY,
    Conditions,
    Job,
    Request,
    list_jobs,
    play_job,
)
from bench.zero_shot_agents import load_zero_shot_agent


def test_zero_shot_plays_every_goal_with_every_player(tmp_path, checkpoint, capsys):
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
    # Agents without the goal play the same episodes for every goal.
    for player in ("actor", "random"):
        assert by_player["objective", player]["returns"] == by_player["constraint", player]["returns"]
    actor = by_player["objective", "actor"]
    assert 100.0 * actor["quantities"]["task.swingup"] == pytest.approx(actor["mean_return"])
    assert result["planner"]["horizon"] == 2 and result["planner"]["goal_horizon"] is None  # as played
    assert "cart < 0.01 (constraint)" in capsys.readouterr().out


def test_zero_shot_adds_rows_of_an_agent_trained_for_the_goal_with_the_reward_of_the_task(
    tmp_path, checkpoint, save_agent
):
    trained = save_agent(tmp_path / "trained", task="balance", objective="cart > 100")  # a reward of 0
    path = tmp_path / "result.json"
    flags = ["--constraints", "cart < 0.01", "--players", "actor, unconstrained", "--trained", str(trained)]
    flags += ["--episodes", "2", "--json", str(path), "--device", "cpu"]
    assert benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), *flags]) == 0
    result = json.loads(path.read_text())
    assert [row["player"] for row in result["rows"]] == ["unconstrained", "actor", "trained planner", "trained actor"]
    _, actor, _, same = result["rows"]
    assert same["returns"] == actor["returns"] != [0.0, 0.0] and same["scores"] == actor["scores"]
    assert result["floor"] == "endless"


def test_push_kicks_the_same_decisions_of_every_player(checkpoint):
    kicked = {seed: any(first_draw(seed, decision) < PUSH_PROBABILITY for decision in range(10)) for seed in range(10)}
    seeds = [next(seed for seed in kicked if kicked[seed] == wanted) for wanted in (True, False)]

    def scores(player, push):
        conditions = Conditions(str(checkpoint), seeds, "cpu", {}, push)
        return play_job(conditions, Job("cart -> 1.0", None, player))["scores"]

    for player in ("actor", "random"):
        pushed, calm = scores(player, 3.0), scores(player, 0.0)
        assert pushed[0] != calm[0] and pushed[1] == calm[1]
    assert scores("random", 3.0) == pushed


def first_draw(seed, decision):
    """The number that decides whether a decision has a kick."""
    return np.random.default_rng((seed, decision)).random()


def test_plain_gate_acts_by_the_actor_between_plans(checkpoint):
    frames = torch.randint(0, 256, (12, 64, 64, 3), dtype=torch.uint8).numpy()
    sources = {}
    for player in ("random gate", "random moments"):
        agent = load_zero_shot_agent(player, str(checkpoint), "cpu", {"horizon": 2})
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
        (("--objectives", "cart > 1", "--players", "unconstrained"), "names no agent"),
        (("--objectives", "cart > 1", "--trained", "nowhere"), "nowhere"),
    ],
)
def test_zero_shot_refuses_bad_goals_in_one_line(capsys, checkpoint, flags, reason):
    assert benchmark.main(["zero-shot", "--checkpoint", str(checkpoint), *flags]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and reason in error


def test_planning_players_share_their_search_settings(checkpoint):
    changes = {"horizon": 2}
    searches = [
        load_zero_shot_agent(player, str(checkpoint), "cpu", changes).controller.planner for player in PLANNING_PLAYERS
    ]
    assert {(search.horizon, search.goal_horizon) for search in searches} == {(2, None)}
