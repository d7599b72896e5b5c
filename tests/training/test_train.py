"""Whole runs, tiny: what they leave behind, how they repeat, stop and go on."""

import shutil

import numpy as np
import pytest
import torch

from latentplan.agents.checkpoint import load_agent, read_info
from latentplan.config import UserError
from latentplan.training import resume, train
from latentplan.training.folder import claim
from latentplan.training.record import COLUMNS
from tests.training.run_folder import epochs_of, rows_of, saved_state


def without_minutes(folder):
    return [{name: value for name, value in row.items() if name != "minutes"} for row in rows_of(folder)]


def test_a_run_ends_with_its_budget_and_a_summary(finished):
    assert finished.exit_code == 0
    assert finished.summary.keys() >= {"planner", "actor"}
    assert all(0.0 <= finished.summary[mode] <= 20.0 for mode in ("planner", "actor"))
    state = saved_state(finished.run_dir)
    assert state["run"]["env_frames"] == state["run"]["decisions"] == 90


def test_every_update_was_made(finished):
    # Prefill 45, then rounds of 15 decisions, 6 updates after asking for each, and 6 with the last one in replay.
    updates = saved_state(finished.run_dir)["learner"]["updates"]
    assert updates == 6 * 4
    assert [int(row["updates"]) for row in epochs_of(finished.run_dir)] == [6, 12, 18, 24]


def test_metrics_have_the_promised_columns(finished):
    rows, epochs = rows_of(finished.run_dir), epochs_of(finished.run_dir)
    assert tuple(rows[0]) == COLUMNS
    clocks = [[float(row[name]) for row in epochs] for name in ("env_frames", "decisions", "updates", "minutes")]
    assert all(np.all(np.diff(clock) >= 0) for clock in clocks)
    losses = COLUMNS[COLUMNS.index("reconstruction") :]
    assert all(np.isfinite(float(row[name])) for row in epochs for name in losses)
    assert any(row["episode_return"] for row in epochs)


def test_evaluations_have_rows_with_the_clocks_of_what_was_judged(finished):
    judged = [row for row in rows_of(finished.run_dir) if row["planner_return"]]
    evaluations = saved_state(finished.run_dir)["run"]["evaluations"]
    assert len(judged) == len(evaluations) > 0
    for row, entry in zip(judged, evaluations, strict=True):
        assert (int(row["env_frames"]), int(row["updates"])) == (entry["env_frames"], entry["updates"])
        assert float(row["planner_minus_actor"]) == pytest.approx(entry["planner"] - entry["actor"])


def test_a_finished_run_holds_an_agent_that_acts(finished):
    info = read_info(finished.run_dir)
    assert info.keys() >= {"domain", "task", "env_frames", "updates", "minutes", "config", "metrics"}
    for name in ("best", "last"):
        action = load_agent(finished.run_dir / "checkpoints" / name).act(np.zeros((64, 64, 3), np.uint8))
        assert action.shape == (1,)


def test_a_run_repeats_with_its_seed(finished, tiny, dot, tmp_path):
    again = train(tiny(tmp_path / "again"), dot)
    assert without_minutes(again.run_dir) == without_minutes(finished.run_dir)
    assert again.summary == finished.summary


def test_collecting_in_another_process_changes_nothing_but_the_time(finished, tiny, dot, tmp_path):
    beside = train(tiny(tmp_path / "beside", collection={"overlap": True}), dot)
    assert beside.exit_code == 0
    assert without_minutes(beside.run_dir) == without_minutes(finished.run_dir)
    assert beside.summary == finished.summary


def test_another_seed_is_another_run(finished, tiny, dot, tmp_path):
    other = train(tiny(tmp_path / "other", run={"seed": 1, "frames": 60}), dot)
    assert without_minutes(other.run_dir)[0] != without_minutes(finished.run_dir)[0]


def test_a_folder_holds_one_run(finished, tiny, dot, tmp_path):
    with pytest.raises(UserError, match="already holds a run"):
        train(tiny(finished.run_dir), dot)
    with pytest.raises(UserError, match="--run-dir must name a folder"):
        train(tiny(""), dot)
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "info.json").touch()
    with pytest.raises(UserError, match="already holds an agent: choose another --run-dir"):
        train(tiny(tmp_path / "agent"), dot)
    with claim(finished.run_dir), pytest.raises(UserError, match="another process learns"):
        resume(finished.run_dir, make_env=dot)
    with claim(tmp_path), pytest.raises(UserError, match="another process learns"):
        train(tiny(tmp_path), dot)
    assert not (tmp_path / "config.yaml").exists()


def test_a_run_needs_an_end(tiny, dot, tmp_path):
    with pytest.raises(UserError, match="give --frames or --minutes"):
        train(tiny(tmp_path / "endless", run={"frames": None}), dot)


def test_an_empty_folder_cannot_be_resumed(tmp_path):
    with pytest.raises(UserError, match="nothing to resume"):
        resume(tmp_path)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("resume/state.pt", "state.pt is damaged"),
        ("resume/replay/rows.pt", "rows.pt is damaged"),
        ("latent_dim", "does not fit the settings in its config.yaml"),
        ("foreign resume/state.pt", "state.pt is damaged"),
        ("foreign resume/replay/rows.pt", "rows.pt is damaged"),
        ("empty", "does not say what the task is"),
    ],
)
def test_what_is_damaged_is_said_in_one_line(damage, said, finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    if damage == "latent_dim":
        text = (folder / "config.yaml").read_text()
        (folder / "config.yaml").write_text(text.replace("latent_dim: 32", "latent_dim: 16"))
    elif damage == "empty":
        (folder / "config.yaml").write_text("")
    elif damage.startswith("foreign"):
        torch.save({"run": {}}, folder / damage.split()[1])
    else:
        (folder / damage).write_bytes((folder / damage).read_bytes()[:-200])
    with pytest.raises(UserError, match=said) as caught:
        resume(folder, make_env=dot)
    assert "\n" not in str(caught.value)


def test_a_run_in_an_environment_of_the_users_own_is_resumed_with_it(finished):
    with pytest.raises(UserError, match="with make_env"):
        resume(finished.run_dir)


@pytest.mark.parametrize("place", ["file", "file/run"])
def test_a_folder_that_cannot_be_made_is_named(place, tiny, dot, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot make the folder"):
        train(tiny(tmp_path / place), dot)


@pytest.mark.parametrize("number", ["nan", "inf"])
def test_a_reward_that_is_not_finite_stops_the_run(number, tiny, dot, tmp_path):
    class Broken(dot):
        def step(self, action):
            picture, _, terminated, truncated, info = super().step(action)
            return picture, float(number), terminated, truncated, info

    with pytest.raises((FloatingPointError, UserError), match="not finite"):
        train(tiny(tmp_path / "run"), Broken)


def test_too_short_episodes_are_explained(tiny, dot, tmp_path):
    class Short(dot):
        def step(self, action):
            picture, reward, terminated, _, info = super().step(action)
            return picture, reward, terminated, self.steps == 4, info

    with pytest.raises(UserError, match=r"sequence_length \(5\)"):
        train(tiny(tmp_path / "run"), Short)


def test_what_the_environment_raises_reaches_the_user_from_another_process(tiny, dot, tmp_path):
    class Failing(dot):
        def step(self, action):
            raise ZeroDivisionError("the dot is lost")

    with pytest.raises(RuntimeError, match="the dot is lost"):
        train(tiny(tmp_path / "run", collection={"overlap": True}), Failing)


def test_a_small_budget_cuts_the_prefill_short(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 25}), dot)
    assert saved_state(run.run_dir)["run"]["env_frames"] == 25
