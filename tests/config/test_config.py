"""Settings: their checks, derived seeds, and the round trip through plain dictionaries."""

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
    ReplayConfig,
    RunConfig,
    UserError,
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
def test_every_preset_has_a_latent_of_32_dimensions(preset):
    config = Config() if preset is None else compose({}, {}, preset)
    assert config.model.latent_dim == 32


@pytest.mark.parametrize("config", [Config(), CHANGED, compose({}, {}, "cpu"), compose({}, {}, "gpu")])
def test_from_dict_inverts_to_dict(config):
    assert from_dict(to_dict(config)) == config


def test_from_dict_takes_defaults_for_absent_settings():
    assert from_dict({"collection": {"noise_std": 0.1}}) == Config(collection=CollectionConfig(noise_std=0.1))
    saved = from_dict({"planner": {"horizon": 3}})  # by a version without the margin, see `ADDED`
    assert saved == Config(planner=PlannerConfig(horizon=3, policy_margin=None))


def test_from_dict_names_unknown_settings():
    with pytest.raises(ValueError, match="'plnner'"):
        from_dict({"plnner": {}})
    with pytest.raises(ValueError, match="planner.horizn"):
        from_dict({"planner": {"horizn": 3}})


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [
        ("model", "decoder_layers", float("inf")),
        ("model", "decoder_layers", 2.5),
        ("model", "decoder_layers", True),
        ("model", "decoder_layers", "2"),
        ("model", "latent_dim", 10**30),
        ("model", "encoder_channels", [8, "x"]),
        ("model", "encoder_channels", 8),
        ("learning", "batch_size", None),
        ("env", "domain", 5),
        ("env", "vectors", [[]]),
        ("run", "device", ["cpu"]),
    ],
)
def test_from_dict_names_the_setting_of_a_value_of_another_type(section, name, value):
    with pytest.raises(UserError, match=rf"{section}\.{name} must be .+, got") as caught:
        from_dict({section: {name: value}})
    assert "\n" not in str(caught.value) and "be s," not in str(caught.value)


def test_from_dict_takes_numbers_of_the_other_type_that_are_equal():
    saved = from_dict({"run": {"frames": 1e5, "minutes": 2}, "env": {"cameras": [0, 1]}})
    assert (saved.run.frames, saved.run.minutes, saved.env.cameras) == (100_000, 2, ("0", "1"))
    assert type(saved.run.frames) is int


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
        (ModelConfig, "decoder_layers", 65),
    ],
)
def test_config_names_the_field_of_a_bad_value(kind, name, value):
    with pytest.raises(ValueError, match=name):
        kind(**{name: value})


def test_config_refuses_collected_episodes_shorter_than_a_sequence():
    Config(collection=CollectionConfig(episode_decisions=16))
    with pytest.raises(ValueError, match=r"episode_decisions \(15\) must be at least 16, learning.sequence_length"):
        Config(collection=CollectionConfig(episode_decisions=15))


def test_config_is_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().planner.horizon = 3


def test_derive_seed_is_a_digest_of_seed_name_and_counter():
    expected = int.from_bytes(hashlib.sha256(b"3/replay/7").digest()[:4], "little") >> 1
    assert derive_seed(3, "replay", 7) == expected
    assert 0 <= expected < 2**31


def test_derive_seed_differs_between_seeds_names_and_counters():
    seeds = {derive_seed(seed, name, count) for seed in (0, 1) for name in ("a", "b") for count in (0, 1)}
    assert len(seeds) == 8


def test_override_planner_uses_a_given_horizon_for_goals_too():
    trained = {"horizon": 5, "goal_horizon": 20, "num_samples": 64}
    assert override_planner(trained, {"num_samples": 8}) == trained | {"num_samples": 8}
    assert override_planner(trained, {"horizon": 9}) == trained | {"horizon": 9, "goal_horizon": None}
    both = {"horizon": 9, "goal_horizon": 12}
    assert override_planner(trained, both) == trained | both


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        (EnvConfig, "cameras"),
        (EnvConfig, "vectors"),
        (ReplayConfig, "demonstrations"),
        (RunConfig, "logger"),
        (CollectionConfig, "goals"),
    ],
)
def test_text_in_place_of_a_tuple_is_refused(kind, field):
    """Its letters would be taken one by one: camera "10" as cameras 1 and 0."""
    with pytest.raises(ValueError, match=rf"{field} must be a tuple such as \('top',\), got the text 'top'"):
        kind(**{field: "top"})
