"""Planner settings in older files: removed fields are dropped or refused, explicit values are kept."""

import json

import pytest

from latentplan.config import Config, PlannerConfig, from_dict
from latentplan.config.planner import REMOVED, drop_removed


def test_from_dict_loads_the_planner_settings_of_every_shipped_checkpoint(root):
    paths = sorted(root.glob("checkpoints/*/info.json"))
    assert len(paths) >= 8
    for path in paths:
        saved = json.loads(path.read_text())["config"]
        planner = from_dict(saved).planner
        kept = {name: value for name, value in saved["planner"].items() if name not in REMOVED}
        assert {name: getattr(planner, name) for name in kept} == kept
        assert planner.method == "cem"


@pytest.mark.parametrize("name", REMOVED)
def test_removed_field_is_refused_with_advice_when_it_has_another_value(name):
    accepted, advice = REMOVED[name]
    assert drop_removed({name: accepted, "horizon": 5}) == {"horizon": 5}
    assert from_dict({"planner": {name: accepted}}) == Config()
    with pytest.raises(ValueError, match=f"{name} 'policy' is no longer supported: {advice}"):
        from_dict({"planner": {name: "policy"}})


def test_planner_config_has_the_effect_of_the_values_that_older_runs_spelled_out():
    spelled = PlannerConfig(warm_start_iterations=2, init_std=0.5, num_policy_samples=24, terminal_value=True)
    derived = PlannerConfig()
    assert derived.num_warm_iterations == spelled.num_warm_iterations
    assert derived.num_proposals(has_policy=True) == spelled.num_proposals(has_policy=True)
