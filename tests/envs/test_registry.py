"""The table of environment suites: one entry is enough to train and evaluate in a new suite."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from latentplan.agents.random import RandomAgent
from latentplan.commands.main import main
from latentplan.config import (
    CollectionConfig,
    Config,
    EnvConfig,
    EvaluationConfig,
    LearningConfig,
    ModelConfig,
    PlannerConfig,
    RunConfig,
    UserError,
)
from latentplan.config.files import compose
from latentplan.config.suites import SUITES, Suite
from latentplan.envs import default_task, make_env, registry
from latentplan.evaluation.clock import Latency, VirtualClock
from latentplan.evaluation.goals import read_goals, score_env
from latentplan.evaluation.timed import iterate_timed_episodes
from latentplan.training import train
from latentplan.training.checks import check_settings

LAMP = EnvConfig(suite="lamps", domain="lamp", action_repeat=2)


@pytest.fixture(autouse=True)
def lamps(monkeypatch):
    monkeypatch.setitem(SUITES, "lamps", Suite("tests.envs.lamp_suite:make", {"lamp": ("bright",)}))


def test_make_env_calls_the_factory_of_the_suite():
    env, twin = make_env(LAMP, seed=3), make_env(LAMP, seed=3)
    frame, _ = env.reset()
    assert frame.shape == (64, 64, 3) and np.array_equal(frame, twin.reset()[0])
    _, reward, _, _, info = env.step(np.ones(1))
    assert 0.0 < reward <= 2.0 and info["env_frames"] == 2
    assert default_task("lamp", "lamps") == "bright"


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"suite": "lamp"}, "unknown suite 'lamp'; available: dm_control"),
        ({"suite": "lamps", "domain": "walker"}, "unknown domain 'walker'; available: lamp"),
        ({"domain": "lamp"}, "unknown domain 'lamp'"),
        ({"domain": ["walker"]}, r"unknown domain \['walker'\]"),
        ({"suite": ["lamps"]}, r"unknown suite \['lamps'\]"),
    ],
)
def test_compose_refuses_unknown_suites_and_domains(config, message):
    with pytest.raises(UserError, match=message):
        compose({"env": config}, {}, "cpu")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"task": "dark"}, "unknown task of lamp 'dark'; available: bright. Did you mean 'bright'"),
        ({"task": ["bright"]}, r"unknown task of lamp \['bright'\]"),
        ({"domain": "lam"}, "unknown domain 'lam'; available: lamp. Did you mean 'lamp'"),
        ({"domain": ["lamp"]}, r"unknown domain \['lamp'\]"),
    ],
)
def test_make_env_refuses_unknown_names_before_the_factory_is_imported(changes, words, monkeypatch):
    monkeypatch.setattr(registry, "importlib", None)
    with pytest.raises(UserError, match=words):
        make_env(replace(LAMP, **changes))


@pytest.mark.parametrize("changes", [{"task": "dark"}, {"domain": "lam"}])
def test_check_settings_refuses_unknown_names_of_every_suite(changes):
    with pytest.raises(UserError, match="unknown"):
        check_settings(replace(Config(), env=replace(LAMP, **changes)))


def test_optional_features_are_refused_when_the_environment_lacks_them():
    env = make_env(LAMP, seed=0)
    with pytest.raises(UserError, match="cannot change within a decision"):
        next(iterate_timed_episodes(env, RandomAgent(1), [0], VirtualClock(50.0, Latency())))
    with pytest.raises(UserError, match="does not report"):
        score_env(env, read_goals("return", None, "lamp"), None)


def test_domains_of_a_suite_are_known_to_the_settings():
    assert compose({"env": {"suite": "lamps", "domain": "lamp"}}, {}, "cpu").env.domain == "lamp"


def test_table_needs_no_simulator(run_python):
    code = "import sys, latentplan.config.files\nprint({'gymnasium', 'mujoco', 'numpy', 'torch'} & set(sys.modules))"
    finished = run_python("-c", code)
    assert finished.stdout.strip() == "set()", finished.stderr


def test_train_and_evaluate_play_a_registered_suite(tmp_path):
    config = Config(
        env=LAMP,
        model=ModelConfig(
            deter_dim=8, hidden_dim=8, decoder_width=4, encoder_channels=(4, 4), decoder_channels=2, num_bins=5
        ),
        planner=PlannerConfig(horizon=2, num_samples=8, num_elites=2, num_iterations=1, num_policy_samples=2),
        learning=LearningConfig(batch_size=4, sequence_length=5, imagination_horizon=3, imagination_starts=8),
        collection=CollectionConfig(prefill_decisions=40, round_decisions=20, updates_per_decision=0.2, overlap=False),
        evaluation=EvaluationConfig(every_frames=80, episodes=1, final_episodes=1, video=False),
        run=RunConfig(frames=160, device="cpu", threads=1, run_dir=str(tmp_path / "run")),
    )
    config = replace(config, planner=replace(config.planner, warm_start_iterations=1))
    assert train(config).exit_code == 0
    with (tmp_path / "run" / "metrics.csv").open(newline="") as file:
        assert int(list(csv.DictReader(file))[-1]["env_frames"]) >= 160
    result = tmp_path / "result.json"
    flags = ["--checkpoint", tmp_path / "run", "--episodes", 1, "--mode", "actor", "--json", result, "--threads", 1]
    assert main(["eval", *map(str, flags)]) == 0
    played = json.loads(result.read_text())
    assert (played["domain"], played["task"]) == ("lamp", "bright")
    assert 0.0 <= played["mean_return"] <= 40.0 and sum(played["action_source"].values()) == 20
