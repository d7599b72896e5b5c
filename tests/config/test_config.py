"""Settings: one source of seeds, an exact round trip, and names in every error."""

import dataclasses
import hashlib

import pytest

from latentplan.config import (
    CollectionConfig,
    Config,
    EnvConfig,
    LearningConfig,
    ModelConfig,
    PlannerConfig,
    RunConfig,
    derive_seed,
    from_dict,
    to_dict,
)
from latentplan.config.files import compose
from latentplan.config.planner import override_planner

CHANGED = Config(
    env=EnvConfig(domain="cartpole", task="swingup", num_envs=3),
    model=ModelConfig(encoder_channels=(8, 16)),
    planner=PlannerConfig(horizon=3, num_samples=9, num_elites=4, num_policy_samples=2),
    learning=LearningConfig(discount=0.9),
    run=RunConfig(frames=100, minutes=0.5),
)


@pytest.mark.parametrize("preset", ["cpu", "gpu", None])
def test_the_latent_has_32_dimensions_in_every_preset(preset):
    config = Config() if preset is None else compose({}, {}, preset)
    assert config.model.latent_dim == 32


def test_a_run_from_python_learns_as_one_from_the_command_line_does():
    composed = compose({}, {"env": {"domain": "fish"}}, "cpu")  # a domain without a file of its own
    for section in ("model", "planner", "learning", "collection", "replay", "evaluation"):
        assert getattr(Config(), section) == getattr(composed, section)


@pytest.mark.parametrize("config", [Config(), CHANGED, compose({}, {}, "cpu"), compose({}, {}, "gpu")])
def test_settings_survive_plain_dictionaries(config):
    assert from_dict(to_dict(config)) == config


def test_absent_settings_take_their_defaults():
    assert from_dict({"planner": {"horizon": 3}}) == Config(planner=PlannerConfig(horizon=3))


def test_unknown_settings_are_named():
    with pytest.raises(ValueError, match="'plnner'"):
        from_dict({"plnner": {}})
    with pytest.raises(ValueError, match="planner.horizn"):
        from_dict({"planner": {"horizn": 3}})


@pytest.mark.parametrize(
    ("kind", "name", "value"),
    [
        (PlannerConfig, "horizon", 0),
        (PlannerConfig, "num_elites", 1000),
        (PlannerConfig, "tail", "head"),
        (PlannerConfig, "smoothing", 0.0),
        (LearningConfig, "discount", 1.5),
        (LearningConfig, "model_learning_rate", float("nan")),
        (RunConfig, "frames", -1),
        (RunConfig, "threads", 999_999),
        (ModelConfig, "encoder_channels", ()),
    ],
)
def test_a_bad_value_names_its_field(kind, name, value):
    with pytest.raises(ValueError, match=name):
        kind(**{name: value})


def test_episodes_too_short_to_learn_from_are_refused():
    Config(collection=CollectionConfig(episode_decisions=16))
    with pytest.raises(ValueError, match=r"episode_decisions \(15\) must be at least 16, learning.sequence_length"):
        Config(collection=CollectionConfig(episode_decisions=15))


def test_settings_cannot_be_written_to():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().planner.horizon = 3


def test_a_derived_seed_is_a_digest_of_run_stream_and_counter():
    expected = int.from_bytes(hashlib.sha256(b"3/replay/7").digest()[:4], "little") >> 1
    assert derive_seed(3, "replay", 7) == expected
    assert 0 <= expected < 2**31


def test_streams_of_a_run_differ():
    seeds = {derive_seed(seed, name, count) for seed in (0, 1) for name in ("a", "b") for count in (0, 1)}
    assert len(seeds) == 8


def test_a_horizon_that_is_given_holds_for_goals_too():
    trained = {"horizon": 5, "goal_horizon": 20, "num_samples": 64}
    assert override_planner(trained, {"num_samples": 8}) == trained | {"num_samples": 8}
    assert override_planner(trained, {"horizon": 9}) == trained | {"horizon": 9, "goal_horizon": None}
    both = {"horizon": 9, "goal_horizon": 12}
    assert override_planner(trained, both) == trained | both
