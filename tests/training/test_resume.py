"""Runs that were interrupted, that crashed or that are to go on for longer."""

import itertools
import os
import shutil
import signal
import time
from types import SimpleNamespace

import pytest
import torch

from latentplan.training import callbacks, resume, train
from latentplan.training.collection.process import LocalWorker
from latentplan.training.train import INTERRUPTED, _Run
from tests.training.run_folder import epochs_of, rows_of, saved_state


def assert_goes_on(before, after):
    """Every clock is later, and what was learned was carried over rather than begun anew."""
    for clock in ("env_frames", "decisions", "rounds"):
        assert after["run"][clock] > before["run"][clock], clock
    assert after["learner"]["updates"] > before["learner"]["updates"]
    assert after["run"]["evaluations"][: len(before["run"]["evaluations"])] == before["run"]["evaluations"]
    updates = after["learner"]["updates"]
    for optimizer in after["optimizers"]:
        assert {entry["step"].item() for entry in optimizer["state"].values()} == {updates}


def test_an_interrupted_run_is_saved_and_goes_on_where_it_was(tiny, dot, tmp_path, interrupting, capsys):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    # Steps: 45 of the prefill, 15 of the first round, 2 x 20 of the first evaluation, then into the second round.
    stopped = train(tiny(tmp_path / "run"), interrupting(dot, at_step=105).make)
    assert (stopped.exit_code, dict(stopped.summary)) == (INTERRUPTED, {})
    assert "make_env=..." in capsys.readouterr().out  # the command line cannot make this environment
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


def test_a_run_in_two_pieces_learns_as_often_as_one(finished, tiny, dot, tmp_path):
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    resume(run.run_dir, frames=90, make_env=dot)
    assert saved_state(run.run_dir)["learner"]["updates"] == saved_state(finished.run_dir)["learner"]["updates"]


def test_judging_is_no_part_of_the_minutes(tiny, dot, tmp_path, monkeypatch):
    judge, ahead = _Run._judge, [0.0]

    def slow(self, *arguments, **more):
        ahead[0] += 3600.0
        return judge(self, *arguments, **more)

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + ahead[0])
    monkeypatch.setattr("latentplan.training.state.time", clock)
    monkeypatch.setattr(_Run, "_judge", slow)
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    assert ahead[0] > 0.0 and saved_state(run.run_dir)["run"]["earlier_minutes"] < 30.0


def test_a_best_agent_that_is_lost_ends_no_run(finished, dot, tmp_path, capsys):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    state = saved_state(folder)
    state["run"]["best_return"] = 1e6
    torch.save(state, folder / "resume" / "state.pt")
    (folder / "checkpoints" / "best" / "weights.safetensors").unlink()
    assert resume(folder, make_env=dot).exit_code == 0
    assert "the best agent so far is lost" in capsys.readouterr().out
    assert (folder / "checkpoints" / "best" / "weights.safetensors").exists()


def test_a_run_is_interrupted_before_it_learns_and_goes_on(tiny, dot, tmp_path, monkeypatch):
    class Gone(LocalWorker):
        """Ends with the run, as a worker does to whose whole group a signal was sent."""

        def submit(self, command, *arguments):
            self.is_gone = command == "collect"
            super().submit(command, *arguments)

        def result(self):
            if not self.is_gone:
                return super().result()
            os.kill(os.getpid(), signal.SIGTERM)
            raise RuntimeError("the process that collects has ended unexpectedly")

    with monkeypatch.context() as patch:
        patch.setattr("latentplan.training.collection.process.LocalWorker", Gone)
        assert train(tiny(tmp_path / "run"), dot).exit_code == INTERRUPTED
    assert saved_state(tmp_path / "run")["run"]["decisions"] == 0
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0


def test_an_extension_that_is_interrupted_goes_on_to_its_new_budget(tiny, dot, tmp_path, interrupting):
    run = train(tiny(tmp_path / "run", run={"frames": 60}), dot)
    stopped = resume(run.run_dir, frames=105, make_env=interrupting(dot, at_step=20).make)
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


def test_an_interruption_loses_no_evaluation(finished, tiny, dot, tmp_path, interrupting):
    # Step 50 lies in the first round, when the evaluation of the prefill has been asked for but not taken.
    stopped = train(tiny(tmp_path / "run"), interrupting(dot, at_step=50).make)
    resume(stopped.run_dir, make_env=dot)
    judged = [entry["env_frames"] for entry in saved_state(stopped.run_dir)["run"]["evaluations"]]
    assert judged == [entry["env_frames"] for entry in saved_state(finished.run_dir)["run"]["evaluations"]]


def test_a_second_interruption_ends_the_run_at_once(tiny, dot, tmp_path, interrupting):
    first = interrupting(dot, at_step=50)
    second = interrupting(first.make, at_step=52)
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
    assert [int(row["updates"]) for row in epochs_of(run.run_dir)] == [6, 12, 18]
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
