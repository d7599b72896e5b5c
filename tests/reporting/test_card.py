"""A card tells what the agent remembers of its own weights and nothing else, in the format of the model hub."""

import ast
import json
import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from latentplan.config import Config, EnvConfig, EvaluationConfig, PlannerConfig, from_dict, to_dict
from latentplan.config.earlier import ADDED
from latentplan.config.spaces import Spaces
from latentplan.evaluation.statistics import confidence_interval
from latentplan.reporting.card import (
    LICENCE,
    CardData,
    CardReturn,
    read_seal,
    recorded_returns,
    render_card,
    seal_card,
)

ROOT = Path(__file__).resolve().parents[2]
CHECKPOINTS = ROOT / "checkpoints"
CONFIG = Config(env=EnvConfig(domain="cartpole", task="swingup", action_repeat=8))
INFO = {
    "domain": "cartpole",
    "task": "swingup",
    "discount": 0.96,
    "env_frames": 4000,
    "updates": 40,
    "action_dim": 1,
    "labels": {"cart": 0.5, "task.swingup": 0.5},
    "sha256": "0" * 64,
}
FINAL = {"planner": [10.0, 30.0], "actor": [5.0, 5.0]}
ENTRY = {"env_frames": 4000, "updates": 40, "minutes": 1.0, "planner": 80.0, "actor": 70.0}


def render(info=INFO, config=CONFIG, spaces=None, **facts):
    return render_card(CardData(info, config, spaces or Spaces(), **facts))


def front_of(card):
    _, front, text = card.split("---\n", 2)
    return yaml.safe_load(front), text


def means(info, config=CONFIG):
    return {entry.mode: entry.mean for entry in recorded_returns(info, config, confidence_interval)}


def test_front_matter_names_licence_task_and_library():
    front, _ = front_of(render())
    assert front["license"] == LICENCE and front["library_name"] == "latentplan"
    assert front["pipeline_tag"] == "reinforcement-learning"
    assert {"reinforcement-learning", "model-based-reinforcement-learning", "cartpole-swingup"} <= set(front["tags"])


def test_licence_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"].lower() == LICENCE and "MIT License" in (ROOT / "LICENSE").read_text()


def test_card_without_returns_has_no_figure_and_says_how_to_measure():
    front, text = front_of(render())
    assert "model-index" not in front
    assert "holds no returns of these weights" in text
    assert "python -m latentplan eval --checkpoint cartpole-swingup --episodes 10" in text


def test_results_are_the_measured_returns_where_there_are_some():
    recorded = CardReturn("planner", 900.0, 10, (890.0, 910.0), "at the end of the training run")
    measured = CardReturn("planner", 870.04, 3, None, "for this card", is_measured=True)
    for returns, value in (([recorded], 900.0), ([measured, recorded], 870.0)):
        front, text = front_of(render(returns=returns))
        (result,) = front["model-index"][0]["results"]
        assert result["task"]["type"] == "reinforcement-learning"
        assert result["dataset"] == {"name": "cartpole-swingup", "type": "cartpole-swingup"}
        assert [(metric["type"], metric["value"]) for metric in result["metrics"]] == [("mean_reward", value)]
        assert "| planner | 10 | 900.0 | 890.0 to 910.0 | at the end of the training run |" in text


def test_final_evaluation_is_taken_with_its_interval():
    planner, actor = recorded_returns(INFO | {"final_evaluation": FINAL}, CONFIG, confidence_interval)
    assert (planner.mean, planner.num_episodes, planner.interval) == (20.0, 2, confidence_interval([10.0, 30.0]))
    assert (actor.mean, actor.origin) == (5.0, "at the end of the training run")


def test_evaluation_during_training_is_taken_only_when_the_weights_are_the_same():
    config = replace(CONFIG, evaluation=EvaluationConfig(episodes=4))
    planner, _ = recorded_returns(INFO | {"metrics": [ENTRY]}, config, confidence_interval)
    assert (planner.mean, planner.num_episodes, planner.interval) == (80.0, 4, None)
    for later in ({"env_frames": 5000}, {"updates": 41}):
        assert means(INFO | {"metrics": [ENTRY]} | later) == {}


def test_returns_before_a_distillation_are_not_those_of_the_agent():
    distilled = {
        "kept_round": 2,
        "returns_before": [1.0],
        "returns_after": [2.0],
        "returns_planner": [3.0],
        "planner": to_dict(CONFIG.planner),
    }
    before = INFO | {"final_evaluation": FINAL, "metrics": [ENTRY]}
    assert means(before | {"distilled": distilled}) == {"actor": 2.0}
    assert means(before | {"distilled": distilled | {"returns_planner_after": [4.0]}}) == {"planner": 4.0, "actor": 2.0}
    assert means(before | {"distilled": distilled | {"kept_round": None}}) == {"planner": 3.0, "actor": 2.0}
    assert means(before | {"distilled": {}}) == {}


def test_planner_of_another_search_is_left_out():
    distilled = {"kept_round": None, "returns_after": [2.0], "returns_planner": [3.0]}
    info = INFO | {"distilled": distilled | {"planner": to_dict(PlannerConfig(horizon=3))}}
    assert means(info) == {"actor": 2.0}
    assert means(info, replace(CONFIG, planner=PlannerConfig(horizon=3))) == {"planner": 3.0, "actor": 2.0}


def test_planner_of_a_search_that_an_earlier_version_saved_is_that_of_its_agent():
    """An earlier version knew no later settings, neither of the agent nor of the search that labelled."""
    earlier = {name: value for name, value in to_dict(CONFIG.planner).items() if name not in ADDED["planner"]}
    distilled = {"kept_round": None, "returns_after": [2.0], "returns_planner": [3.0], "planner": earlier}
    assert means(INFO | {"distilled": distilled}, from_dict({"planner": earlier})) == {"planner": 3.0, "actor": 2.0}


@pytest.mark.parametrize("damaged", [[], [1.0, "2"], [math.nan], [10**400], [[1.0]], "10", {"a": 1}, None, 3.0])
def test_damaged_records_are_no_returns(damaged):
    assert means(INFO | {"final_evaluation": {"planner": damaged, "actor": [1.0]}}) == {"actor": 1.0}
    assert means(INFO | {"distilled": {"returns_after": damaged, "planner": damaged}}) == {}


def test_text_of_a_description_cannot_leave_its_place():
    hostile = "x`\n\n# Heading | <script>\n---\n```\n"
    config = replace(CONFIG, env=replace(CONFIG.env, objective=hostile, kwargs='{"a": "|`"}'))
    info = INFO | {"task": hostile, "version": hostile, "renderer": {"renderer": hostile}}
    card = render(info, config, returns=[CardReturn("planner", 1.0, 1, None, "for this card")])
    front, text = front_of(card)
    assert front["license"] == LICENCE
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    assert headings[1:] == ["Task", "Returns", "Training", "Use", "Licence"]
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert {line.count("|") for line in tables} <= {3, 6}


def test_code_of_the_card_is_python_for_every_kind_of_agent():
    spaces = Spaces(choices=(0, 3), frame_size=96, cameras=2, vector_dim=7)
    card = render(INFO | {"action_dim": 2, "labels": None}, spaces=spaces)
    (block,) = re.findall(r"^```python\n(.*?)^```", card, flags=re.DOTALL | re.MULTILINE)
    ast.parse(block)
    assert "np.zeros((96, 96, 6), dtype=np.uint8)" in block and "agent.act((frame, vectors))" in block
    assert "2 in [-1, 1], 1 of them categories" in card and "and 7 numbers beside each frame" in card


def test_agent_of_a_users_function_gets_no_command_that_cannot_work():
    card = render(INFO | {"domain": "user", "task": "make_env"}, replace(CONFIG, env=EnvConfig(domain="user")))
    assert "latentplan eval" not in card and "evaluate_agent" in card


def test_agent_of_a_module_gets_the_flag_that_its_command_needs():
    env = EnvConfig(suite="gymnasium", domain="gymnasium", task="my_robot:Reach-v0")
    card = render(INFO | {"domain": "gymnasium", "task": "my_robot:Reach-v0"}, replace(CONFIG, env=env))
    assert "--checkpoint my_robot-Reach-v0 --episodes 10 --env-id my_robot:Reach-v0" in card


def test_seal_tells_an_edited_card_and_an_earlier_agent():
    card = seal_card(render(), "a" * 64)
    assert read_seal(card) == ("a" * 64, True)
    assert read_seal(card.replace("# cartpole", "# My cartpole", 1)) == ("a" * 64, False)
    assert read_seal(render()) is None and read_seal("") is None and read_seal(f"{card}\nmore") is None


@pytest.mark.parametrize("name", sorted(path.name for path in CHECKPOINTS.iterdir()))
def test_card_of_a_shipped_agent_has_no_figure_that_its_folder_has_not(name):
    info = json.loads((CHECKPOINTS / name / "info.json").read_text())
    config = from_dict(info["config"])
    returns = recorded_returns(info, config, confidence_interval)
    front, text = front_of(render(info, config, returns=returns))
    known = [sum(values) / len(values) for values in _lists(info)]
    for entry in returns:
        assert any(math.isclose(entry.mean, value) for value in known)
    results = front.get("model-index", [{"results": [{"metrics": []}]}])[0]["results"]
    assert len(results[0]["metrics"]) == len(returns)
    assert f"| seed | {info['config']['run']['seed']} |" in text and f"{info['env_frames']:,}" in text


def test_client_of_the_hub_reads_the_card():
    client = pytest.importorskip("huggingface_hub")
    returns = recorded_returns(INFO | {"final_evaluation": FINAL}, CONFIG, confidence_interval)
    card = client.ModelCard(seal_card(render(returns=returns, film="replay.mp4"), "a" * 64))
    assert card.data.model_name == "cartpole-swingup" and card.data.license == "mit"
    assert [(result.metric_type, result.metric_value) for result in card.data.eval_results] == [
        ("mean_reward", 20.0),
        ("mean_reward", 5.0),
    ]


def _lists(value):
    """Every list of numbers in a description."""
    if isinstance(value, dict):
        for inner in value.values():
            yield from _lists(inner)
    elif isinstance(value, list) and value and all(isinstance(each, float) for each in value):
        yield value
