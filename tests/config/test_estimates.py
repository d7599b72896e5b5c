"""Settings that the machine cannot serve are refused; settings that ship are not."""

from dataclasses import replace

import pytest

from latentplan.config import Config, ModelConfig, UserError
from latentplan.config.estimates import check_parts, count_parameters, estimate_model, estimate_search
from latentplan.config.files import DOMAINS, compose
from latentplan.models import WorldModel
from latentplan.training import estimates
from latentplan.training.estimates import check_run

GIB = 2**30
MODELS = [
    ModelConfig(),
    ModelConfig(
        deter_dim=64, hidden_dim=96, decoder_width=48, encoder_channels=(8, 16), decoder_channels=4, num_bins=31
    ),
]


@pytest.mark.parametrize("sizes", MODELS)
def test_count_parameters_is_close_to_the_model(sizes):
    model = WorldModel(sizes, action_dim=6)
    actual = sum(parameter.numel() for parameter in model.parameters())
    assert 0.8 * actual < count_parameters(sizes, 6) <= actual


@pytest.mark.parametrize("domain", DOMAINS)
def test_check_run_accepts_the_shipped_settings_on_a_small_machine(domain, monkeypatch):
    monkeypatch.setattr(estimates, "free_memory", lambda: 6 * GIB)
    check_run(compose({}, {"env": {"domain": domain}}, "cpu"))


@pytest.mark.parametrize(
    ("section", "changes", "words"),
    [
        ("planner", {"num_samples": 10**9}, "--planner.num_samples"),
        ("planner", {"num_samples": 10**17, "num_elites": 1}, "--planner.num_samples"),
        ("planner", {"horizon": 10**8}, "--planner.horizon"),
        ("planner", {"goal_horizon": 10**8}, "--planner.horizon"),
        ("planner", {"num_iterations": 10**9}, "s per decision"),
        ("planner", {"gradient_steps": 10**9}, "--planner.gradient_steps"),
        ("planner", {"horizon": 10**9, "deadline_ms": 1.0}, "--planner.horizon"),
        ("model", {"deter_dim": 10**9}, "--model.deter_dim"),
        ("model", {"hidden_dim": 10**9}, "the model takes"),
        ("model", {"num_bins": 10**12}, "the model takes"),
        ("model", {"encoder_channels": (10**9,)}, "the model takes"),
        ("model", {"decoder_channels": 10**8}, "the model takes"),
        ("learning", {"batch_size": 10**9}, "--learning.batch_size"),
        ("learning", {"sequence_length": 10**6}, "--learning.sequence_length"),
        ("learning", {"imagination_starts": 10**12}, "--learning.imagination_starts"),
        ("learning", {"imagination_horizon": 10**12}, "an update takes"),
        ("collection", {"prefill_decisions": 10**15}, "--collection.prefill_decisions"),
        ("collection", {"round_decisions": 10**15}, "--collection.round_decisions"),
        ("collection", {"updates_per_decision": 1e9}, "--collection.updates_per_decision"),
        ("replay", {"capacity": 10**15}, "--replay.capacity"),
        ("run", {"frames": 10**15}, "--frames"),
        ("env", {"num_envs": 1024}, "--env.num_envs"),
    ],
)
def test_check_run_refuses_what_does_not_fit_and_names_the_setting(section, changes, words, monkeypatch):
    monkeypatch.setattr(estimates, "free_memory", lambda: 16 * GIB)
    config = compose({}, {"run": {"device": "cpu", "minutes": 5.0}}, "cpu")
    with pytest.raises(UserError) as error:
        check_run(replace(config, **{section: replace(getattr(config, section), **changes)}))
    assert words in str(error.value) and len(str(error.value)) < 300


def test_check_run_refuses_parts_that_fit_alone_but_not_together(monkeypatch):
    monkeypatch.setattr(estimates, "free_memory", lambda: 3 * GIB)
    config = replace(
        Config(), replay=replace(Config().replay, capacity=150_000), run=replace(Config().run, frames=1000)
    )
    check_run(config)
    with pytest.raises(UserError, match="in all"):
        check_run(replace(config, env=replace(config.env, num_envs=40)))


def test_estimates_grow_with_every_size():
    search, model = Config().planner, ModelConfig()
    base = estimate_search(search, model)
    for changes in ({"num_samples": 256}, {"horizon": 16}, {"goal_horizon": 16}):
        larger = estimate_search(replace(search, **changes), model)
        assert larger.num_bytes > base.num_bytes and larger.seconds > base.seconds
    assert estimate_model(replace(model, deter_dim=400)).num_bytes > estimate_model(model).num_bytes
    check_parts([base], free=GIB)
