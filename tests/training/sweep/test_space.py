"""The file of a sweep's space: what it may hold, and how a mistake is answered."""

import re

import pytest

from latentplan.commands.main import main
from latentplan.config import UserError, extras
from latentplan.training.sweep.space import Range, as_layer, check_space, ends_of, read_space

SPACE = """
learning:
  model_learning_rate: {low: 1e-4, high: 1e-2, log: true}
planner:
  horizon: {low: 3, high: 8}
collection:
  behaviour: [planner, both]
"""


def test_read_space_reads_ranges_and_choices(tmp_path):
    (tmp_path / "space.yaml").write_text(SPACE)
    space = read_space(tmp_path / "space.yaml")
    assert space == {
        "learning.model_learning_rate": Range(1e-4, 1e-2, True, False),
        "planner.horizon": Range(3, 8, False, True),
        "collection.behaviour": ("planner", "both"),
    }
    assert ends_of(space)[2:4] == [{"planner": {"horizon": 3}}, {"planner": {"horizon": 8}}]
    assert as_layer({"planner.horizon": 3, "env.domain": "reacher", "planner.num_samples": 9}) == {
        "planner": {"horizon": 3, "num_samples": 9},
        "env": {"domain": "reacher"},
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names no setting to vary"),
        ("planner: {horizn: [3]}", "unknown setting .*planner.horizn"),
        ("run: {seed: [1, 2]}", "cannot vary run.seed"),
        ("planner: {horizon: 3}", "must be a list of values, or have low, high"),
        ("planner: {horizon: []}", "must list numbers, words or null"),
        ("planner: {horizon: {low: 3, high: 8, step: 2}}", "must be a list of values, or have low, high"),
        ("planner: {horizon: {low: 3.5, high: 8}}", "needs whole numbers"),
        ("planner: {horizon: {low: 8, high: 3}}", r"low \(8\) must be below high \(3\)"),
        ("collection: {noise_std: {low: 0, high: 1, log: true}}", "low must be above 0 with log: true"),
        ("collection: {noise_std: {low: few, high: 1}}", "needs numbers as low and high, got 'few'"),
        ("collection: {noise_std: {low: .nan, high: 1}}", "needs numbers as low and high"),
        ("collection: {behaviour: {low: 0, high: 1}}", "is no number: list its values"),
        ("collection: {noise_std: {low: 0, high: 1, log: much}}", "log must be true or false"),
    ],
)
def test_read_space_refuses_what_a_sweep_cannot_vary(tmp_path, text, message):
    (tmp_path / "space.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        read_space(tmp_path / "space.yaml")


def sweep(tmp_path, *flags, text=SPACE):
    (tmp_path / "space.yaml").write_text(text)
    return main(["sweep", "--space", str(tmp_path / "space.yaml"), "--out", str(tmp_path / "out"), *flags])


@pytest.fixture
def no_optuna(monkeypatch):
    """Optuna is not installed."""
    found = extras.util.find_spec
    monkeypatch.setattr(extras.util, "find_spec", lambda name: None if name in ("ray", "optuna") else found(name))


def test_sweep_without_ray_says_what_to_install(tmp_path, capsys, no_optuna):
    assert sweep(tmp_path, "--frames", "1000") == 2
    assert capsys.readouterr().err == (
        "error: latentplan sweep needs ray, which is not installed; run: pip install 'latentplan[ray]'\n"
    )


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        ([], "planner: {action_spline: [linear, cubic], num_knots: [3, 4]}"),
        (["--planner.num_knots", "3"], "planner: {action_spline: [linear, cubic]}"),
        ([], "planner: {num_elites: [16, 100], num_samples: [64, 128]}"),  # 64 goes with 16, and 100 with 128
        ([], "planner: {action_spline: [null, cubic], num_knots: [null, 4]}"),
    ],
)
def test_sweep_accepts_values_that_are_allowed_in_some_combination(tmp_path, capsys, flags, text):
    assert sweep(tmp_path, *flags, text=text) == 2  # for want of a budget, which is asked for after the space
    assert capsys.readouterr().err == "error: a sweep needs --frames, the budget of a trial\n"


def test_check_space_finds_a_refused_choice_among_very_many_combinations():
    space = {f"planner.x{number}": (0, 1, 2) for number in range(20)}
    tried = []

    def check(values):
        tried.append(values["planner"])
        if values["planner"]["x7"] == 2:
            raise UserError("x7 cannot be 2")

    with pytest.raises(UserError, match="x7 cannot be 2"):
        check_space(space, check)
    assert len(tried) < 200
    assert check_space({**space, "planner.x7": (0, 1)}, check)["planner"].keys() == {f"x{n}" for n in range(20)}


@pytest.mark.parametrize(
    ("flags", "text", "message"),
    [
        ([], SPACE, "a sweep needs --frames, the budget of a trial"),
        (["--planner.horizon", "4"], SPACE, "--planner.horizon is a setting that .* varies"),
        ([], "planner: {horizon: {low: 0, high: 4}}", "planner.horizon must be a whole number, at least 1, got 0"),
        ([], "collection: {behaviour: [planner, sleep]}", "collection.behaviour must be one of"),
        ([], "planner: {num_elites: [100], num_samples: [64]}", r"num_elites \(100\) must not exceed num_samples \(64"),
        ([], "planner: {num_elites: [9, 300], num_samples: {low: 64, high: 128}}", r"num_elites \(300\) must not exce"),
        (["--run-dir", "x"], SPACE, "give --out"),
        (["--trials", "0"], SPACE, "--trials must be at least 1, got 0"),
    ],
)
def test_sweep_refuses_a_mistake_before_its_first_trial(tmp_path, capsys, no_optuna, flags, text, message):
    assert sweep(tmp_path, *flags, text=text) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and re.search(message, error), error
    assert not (tmp_path / "out").exists()


def test_sweep_refuses_to_keep_the_episodes_of_several_runs_in_one_folder(tmp_path, capsys):
    assert sweep(tmp_path, "--frames", "1000", "--collection.keep_episodes", str(tmp_path / "kept")) == 2
    assert "--collection.keep_episodes is the folder of one run" in capsys.readouterr().err


def test_range_over_a_setting_with_gaps_is_refused(tmp_path, capsys):
    assert sweep(tmp_path, "--frames", "1000", text="env: {frame_size: {low: 64, high: 128}}") == 2
    assert "env.frame_size must be one of 64, 84, 96, 128, got 65" in capsys.readouterr().err
