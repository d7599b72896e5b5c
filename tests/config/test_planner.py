"""Planner settings in older files: removed fields are dropped or refused, explicit values are kept."""

import json

import pytest

from latentplan.config import PlannerConfig, from_dict
from latentplan.config.earlier import drop_removed
from latentplan.planning import PLANNERS, make_planner


def test_from_dict_loads_the_planner_settings_of_every_shipped_checkpoint(root):
    paths = sorted(root.glob("checkpoints/*/info.json"))
    assert len(paths) >= 8
    for path in paths:
        saved = json.loads(path.read_text())["config"]
        planner = from_dict(saved).planner
        kept = drop_removed("planner", saved["planner"])
        assert {name: getattr(planner, name) for name in kept} == kept
        assert planner.method == "cem"


def test_planner_config_has_the_effect_of_the_values_that_older_runs_spelled_out():
    spelled = PlannerConfig(warm_start_iterations=2, init_std=0.5, num_policy_samples=24, terminal_value=True)
    derived = PlannerConfig()
    assert derived.num_warm_iterations == spelled.num_warm_iterations
    assert derived.num_proposals(has_policy=True) == spelled.num_proposals(has_policy=True)


@pytest.mark.parametrize("method", PLANNERS)
def test_planner_config_refuses_what_its_planner_would_refuse(method):
    settings = {"method": method, "num_samples": 8, "num_policy_samples": 0}
    if method == "mppi":  # the planner takes all samples as elites
        assert make_planner(method, PlannerConfig(**settings), action_dim=1).num_best == 8
        return
    with pytest.raises(ValueError, match="num_elites .* must not exceed num_samples"):
        PlannerConfig(**settings)


def test_planner_config_leaves_num_elites_to_a_planner_of_the_user():
    assert PlannerConfig(method="mine", num_samples=8, num_policy_samples=0).num_elites == 16


def test_planner_config_checks_num_elites_only_if_the_method_uses_the_value():
    assert PlannerConfig(method="mppi", num_samples=8, num_policy_samples=4).num_elites == 16  # mppi takes all samples
    for settings in ({"num_samples": 8}, {"method": "mppi", "num_samples": 8, "num_elites": 9}):
        with pytest.raises(ValueError, match="num_elites .* must not exceed num_samples"):
            PlannerConfig(num_policy_samples=4, **settings)


def test_error_names_the_word_null_as_settings_spell_it():
    with pytest.raises(ValueError, match="^action_spline must be one of null, zero, linear, cubic, got 'wave'$"):
        PlannerConfig(action_spline="wave")
