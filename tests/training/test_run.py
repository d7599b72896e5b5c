"""Whole runs, tiny: what they leave behind, how they repeat, stop and go on."""

import csv
import itertools
import os
import shutil
import signal

import numpy as np
import pytest
import torch

from latentplan.checkpoint import load_agent, read_info
from latentplan.config import UserError
from latentplan.training import callbacks, resume, train
from latentplan.training.claim import claim
from latentplan.training.record import COLUMNS
from latentplan.training.run import INTERRUPTED


def rows_of(folder):
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def epochs_of(folder):
    """The rows of epochs, without those of evaluations."""
    return [row for row in rows_of(folder) if row["reconstruction"]]


def without_minutes(folder):
    return [{name: value for name, value in row.items() if name != "minutes"} for row in rows_of(folder)]


def saved_state(folder):
    return torch.load(folder / "resume" / "state.pt", weights_only=True)


def assert_goes_on(before, after):
    """Every clock is later, and what was learned was carried over rather than begun anew."""
    for clock in ("env_frames", "decisions", "rounds"):
        assert after["run"][clock] > before["run"][clock], clock
    assert after["learner"]["updates"] > before["learner"]["updates"]
    assert after["run"]["evaluations"][: len(before["run"]["evaluations"])] == before["run"]["evaluations"]
    updates = after["learner"]["updates"]
    for optimizer in after["optimizers"]:
        assert {entry["step"].item() for entry in optimizer["state"].values()} == {updates}


@pytest.fixture(scope="module")
def finished(tiny, dot, tmp_path_factory):
    """A run that came to its end."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    return train(tiny(folder), dot)


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
    ],
)
def test_what_is_damaged_is_said_in_one_line(damage, said, finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    if damage == "latent_dim":
        text = (folder / "config.yaml").read_text()
        (folder / "config.yaml").write_text(text.replace("latent_dim: 32", "latent_dim: 16"))
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


class Interrupting:
    """A factory of environments that press Ctrl-C at a given step of all, once."""

    def __init__(self, kind, at_step):
        self.steps_left = at_step
        outer = self

        class Interrupted(kind):
            def step(self, action):
                outer.steps_left -= 1
                if outer.steps_left == 0:
                    os.kill(os.getpid(), signal.SIGINT)
                return super().step(action)

        self.make = Interrupted


def test_an_interrupted_run_is_saved_and_goes_on_where_it_was(tiny, dot, tmp_path):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    # Steps: 45 of the prefill, 15 of the first round, 2 x 20 of the first evaluation, then into the second round.
    stopped = train(tiny(tmp_path / "run"), Interrupting(dot, at_step=105).make)
    assert (stopped.exit_code, dict(stopped.summary)) == (INTERRUPTED, {})
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
    before = saved_state(stopped.run_dir)
    assert before["run"]["env_frames"] < 90
    gone_on = resume(stopped.run_dir, make_env=dot)
    assert (gone_on.run_dir, gone_on.exit_code) == (stopped.run_dir, 0)
    after = saved_state(stopped.run_dir)
    assert_goes_on(before, after)
    assert after["run"]["env_frames"] == 90
    updates = [int(row["updates"]) for row in epochs_of(stopped.run_dir)]
    assert updates == sorted(set(updates))


def test_a_finished_run_can_be_extended(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    before = saved_state(run.run_dir)
    resume(run.run_dir, frames=90, make_env=dot)
    after = saved_state(run.run_dir)
    assert_goes_on(before, after)
    assert after["run"]["env_frames"] == 90


def test_an_extension_that_is_interrupted_goes_on_to_its_new_budget(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    stopped = resume(run.run_dir, frames=105, make_env=Interrupting(dot, at_step=20).make)
    assert stopped.exit_code == INTERRUPTED and saved_state(run.run_dir)["run"]["env_frames"] < 105
    resume(run.run_dir, make_env=dot)
    assert saved_state(run.run_dir)["run"]["env_frames"] == 105


def test_a_run_that_ends_before_its_first_save_can_be_resumed(finished, tiny, dot, tmp_path):
    """Of the same run as if it had not ended: nothing that it had written stays twice."""
    steps = itertools.count()
    step = {"step": lambda self, action: dot.step(self, action) if next(steps) < 100 else 1 / 0}
    with pytest.raises(ZeroDivisionError):
        train(tiny(tmp_path / "run", evaluation={"every_frames": 10**6}), type("Crashing", (dot,), step))
    assert len(rows_of(tmp_path / "run")) > 0 and saved_state(tmp_path / "run")["learner"]["updates"] == 0
    resume(tmp_path / "run", make_env=dot)
    assert saved_state(tmp_path / "run")["learner"]["updates"] == saved_state(finished.run_dir)["learner"]["updates"]
    updates = [int(row["updates"]) for row in rows_of(tmp_path / "run")]
    assert len(updates) == len(set(updates))


def test_resuming_a_finished_run_judges_the_same_agent(finished, dot):
    again = resume(finished.run_dir, make_env=dot)
    assert again.summary == finished.summary


def test_a_finished_run_that_is_judged_again_can_still_be_extended(finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    before = saved_state(folder)
    before["run"]["best_return"] = float("-inf")  # so that this evaluation is the best, and saved
    torch.save(before, folder / "resume" / "state.pt")
    resume(folder, make_env=dot)
    after = saved_state(folder)
    assert after["run"]["best_return"] > float("-inf")
    states = [[optimizer["state"].keys() for optimizer in saved["optimizers"]] for saved in (before, after)]
    assert states[0] == states[1] and all(states[0])


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


def test_an_interruption_loses_no_evaluation(finished, tiny, dot, tmp_path):
    # Step 50 lies in the first round, when the evaluation of the prefill has been asked for but not taken.
    stopped = train(tiny(tmp_path / "run"), Interrupting(dot, at_step=50).make)
    resume(stopped.run_dir, make_env=dot)
    judged = [entry["env_frames"] for entry in saved_state(stopped.run_dir)["run"]["evaluations"]]
    assert judged == [entry["env_frames"] for entry in saved_state(finished.run_dir)["run"]["evaluations"]]


def test_a_second_interruption_ends_the_run_at_once(tiny, dot, tmp_path):
    first = Interrupting(dot, at_step=50)
    second = Interrupting(first.make, at_step=52)
    with pytest.raises(SystemExit) as ended:
        train(tiny(tmp_path / "run"), second.make)
    assert ended.value.code == INTERRUPTED
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_metrics_after_the_last_save_are_written_anew(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    lines = (run.run_dir / "metrics.csv").read_text().splitlines(keepends=True)
    lost = lines[-1].replace("60,60,12,", "75,75,18,", 1)
    assert lost != lines[-1]
    (run.run_dir / "metrics.csv").write_text("".join([*lines, lost]))  # as a run that was killed leaves it
    resume(run.run_dir, frames=75, make_env=dot)
    assert [int(row["updates"]) for row in epochs_of(run.run_dir)] == [6, 12, 18, 24]
    assert lost not in (run.run_dir / "metrics.csv").read_text()


def test_what_a_crash_loses_is_minutes_not_evaluations(tiny, dot, tmp_path, monkeypatch):
    steps = itertools.count(-45 - 2 * 20 - 3 * 15)  # of the prefill, its evaluation and three rounds
    monkeypatch.setattr(callbacks, "SAVE_MINUTES", 0.0)
    step = {"step": lambda self, action: dot.step(self, action) if next(steps) < 5 else 1 / 0}
    config = tiny(tmp_path / "run", evaluation={"every_frames": 10**6}, run={"frames": 120})
    with pytest.raises(ZeroDivisionError):
        train(config, type("Crashing", (dot,), step))
    assert (before := saved_state(tmp_path / "run"))["run"]["env_frames"] == 75
    resume(tmp_path / "run", make_env=dot)
    assert_goes_on(before, saved_state(tmp_path / "run"))


def test_a_small_budget_cuts_the_prefill_short(tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 25}), dot)
    assert saved_state(run.run_dir)["run"]["env_frames"] == 25
