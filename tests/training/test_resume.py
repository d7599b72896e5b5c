"""Resumption of runs that were interrupted, crashed or finished."""

import itertools
import os
import re
import shutil
import signal
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from latentplan.config import UserError
from latentplan.config.files import dump_config, read_config
from latentplan.training import resume, saving, train
from latentplan.training.collection.collector import Collected
from latentplan.training.collection.process import LocalWorker, WorkerEnded
from latentplan.training.learner.registry import WORLD_MODEL_LOSSES, register
from latentplan.training.run import _Run
from tests.training.run_folder import list_saves, read_epochs, read_rows, read_state, seal, write_state


class Crash(BaseException):
    """Ends the program; an exception of another kind would only end the episode."""


def crash():
    raise Crash


def assert_continues(before, after):
    """Every clock is later, and optimizers and evaluations are the saved ones rather than new ones."""
    for clock in ("env_frames", "decisions", "rounds"):
        assert after["run"][clock] > before["run"][clock], clock
    assert after["learner"]["updates"] > before["learner"]["updates"]
    assert after["run"]["evaluations"][: len(before["run"]["evaluations"])] == before["run"]["evaluations"]
    updates = after["learner"]["updates"]
    for optimizer in after["optimizers"]:
        assert {entry["step"].item() for entry in optimizer["state"].values()} == {updates}


def test_resume_continues_an_interrupted_run(tiny, dot, tmp_path, interrupting, capsys):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    # Steps: 45 of the prefill, 15 of the first round, 2 x 20 of the first evaluation, then into the second round.
    stopped = train(tiny(tmp_path / "run"), interrupting(dot, at_step=105).make)
    assert (stopped.exit_code, dict(stopped.summary)) == (130, {})
    printed = capsys.readouterr().out
    assert "make_env=..." in printed  # the command line cannot make this environment
    assert re.search(r"^renderer    the user's environment; [\d.]+ ms per frame$", printed, re.MULTILINE)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == handlers
    before = read_state(stopped.run_dir)
    assert before["run"]["env_frames"] < 90
    resumed = resume(stopped.run_dir, make_env=dot)
    assert (resumed.run_dir, resumed.exit_code) == (stopped.run_dir, 0)
    after = read_state(stopped.run_dir)
    assert_continues(before, after)
    assert after["run"]["env_frames"] == 90
    updates = [int(row["updates"]) for row in read_epochs(stopped.run_dir)]
    assert updates == sorted(set(updates))


def test_resume_extends_a_finished_run(short, extended):
    after = read_state(extended.run_dir)
    assert_continues(read_state(short.run_dir), after)
    assert after["run"]["env_frames"] == 90


def test_resume_makes_as_many_updates_as_one_long_run(finished, extended):
    updates = [read_state(run.run_dir)["learner"]["updates"] for run in (extended, finished)]
    assert updates[0] == updates[1]


def test_resume_keeps_the_column_of_a_removed_loss_and_adds_the_column_of_a_new_one(
    extended, dot, tmp_path, restored_losses
):
    folder = shutil.copytree(extended.run_dir, tmp_path / "run")
    save = list_saves(folder)[-1]
    header, *lines = (save / "metrics.csv").read_text().splitlines()
    header = header.replace(",overshooting", ",imitation")  # as if an earlier version had had that loss instead
    (save / "metrics.csv").write_text("".join(f"{line}\r\n" for line in (header, *lines)))
    seal(save)
    register(WORLD_MODEL_LOSSES, "largest_reward")(lambda predicted: predicted.batch.rewards.abs().max())
    resume(folder, frames=105, make_env=dot)
    *rows, last = read_epochs(folder)
    assert list(last) == [*header.split(","), "overshooting", "largest_reward"]
    assert [row["imitation"] for row in rows] == [row["overshooting"] for row in read_epochs(extended.run_dir)]
    assert {row["overshooting"] for row in rows} == {row["largest_reward"] for row in rows} == {""}
    assert last["imitation"] == "" and float(last["overshooting"]) > 0.0 and 0.0 < float(last["largest_reward"]) <= 1.0


def test_final_evaluation_is_not_counted_in_the_minutes(short, dot, tmp_path, monkeypatch):
    evaluate, ahead = _Run._evaluate, [0.0]

    def slow(self, *arguments, **more):
        ahead[0] += 3600.0
        return evaluate(self, *arguments, **more)

    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + ahead[0])
    monkeypatch.setattr("latentplan.training.state.time", clock)
    monkeypatch.setattr(_Run, "_evaluate", slow)
    run = resume(shutil.copytree(short.run_dir, tmp_path / "run"), make_env=dot)
    assert ahead[0] > 0.0 and read_state(run.run_dir)["run"]["earlier_minutes"] < 30.0


def test_resume_survives_the_loss_of_the_best_agent(finished, dot, tmp_path, capsys):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    state = read_state(folder)
    state["run"]["best_return"] = 1e6
    write_state(folder, state)
    (folder / "checkpoints" / "best" / "weights.safetensors").unlink()
    assert resume(folder, make_env=dot).exit_code == 0
    assert "the best agent so far cannot be read" in capsys.readouterr().out
    assert (folder / "checkpoints" / "best" / "weights.safetensors").exists()


def test_resume_continues_a_run_interrupted_before_it_learned(tiny, dot, tmp_path, monkeypatch):
    class InterruptedWorker(LocalWorker):
        """A worker whose process the same signal ends as the run, as when a signal reaches the whole process group."""

        def submit(self, command, *arguments):
            if command == "collect":
                os.kill(os.getpid(), signal.SIGTERM)
            super().submit(command, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr("latentplan.training.collection.crew.LocalWorker", InterruptedWorker)
        assert train(tiny(tmp_path / "run"), dot).exit_code == 143
    assert read_state(tmp_path / "run")["run"]["decisions"] == 0
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0


def test_resume_keeps_the_new_budget_of_an_interrupted_extension(short, dot, tmp_path, interrupting):
    folder = shutil.copytree(short.run_dir, tmp_path / "run")
    stopped = resume(folder, frames=90, make_env=interrupting(dot, at_step=10).make)
    assert stopped.exit_code == 130 and read_state(folder)["run"]["env_frames"] < 90
    resume(folder, make_env=dot)
    assert read_state(folder)["run"]["env_frames"] == 90


def test_resume_repeats_a_run_that_crashed_before_its_first_save(finished, tiny, dot, tmp_path):
    """The metrics of the crashed run do not stay beside those of the repetition."""
    steps = itertools.count()
    step = {"step": lambda self, action: dot.step(self, action) if next(steps) < 105 else crash()}
    with pytest.raises(Crash):
        train(tiny(tmp_path / "run", evaluation={"every_frames": 10**6}), type("Crashing", (dot,), step))
    assert len(read_rows(tmp_path / "run")) > 0 and read_state(tmp_path / "run")["learner"]["updates"] == 0
    resume(tmp_path / "run", make_env=dot)
    assert read_state(tmp_path / "run")["learner"]["updates"] == read_state(finished.run_dir)["learner"]["updates"]
    updates = [int(row["updates"]) for row in read_rows(tmp_path / "run")]
    assert len(updates) == len(set(updates))


def test_resume_evaluates_the_same_agent_of_a_finished_run(finished, dot):
    again = resume(finished.run_dir, make_env=dot)
    assert again.summary == finished.summary


def test_resume_of_a_finished_run_saves_its_optimizers_again(finished, dot, tmp_path):
    folder = shutil.copytree(finished.run_dir, tmp_path / "run")
    before = read_state(folder)
    before["run"]["best_return"] = float("-inf")  # so that this evaluation is the best, and saved
    write_state(folder, before)
    resume(folder, make_env=dot)
    after = read_state(folder)
    assert after["run"]["best_return"] > float("-inf")
    states = [[optimizer["state"].keys() for optimizer in saved["optimizers"]] for saved in (before, after)]
    assert states[0] == states[1] and all(states[0])


def test_resume_repeats_an_evaluation_that_an_interruption_cut_off(finished, tiny, dot, tmp_path, interrupting):
    # Step 50 lies in the first round, when the evaluation of the prefill has been asked for but not taken.
    stopped = train(tiny(tmp_path / "run"), interrupting(dot, at_step=50).make)
    resume(stopped.run_dir, make_env=dot)
    evaluated = [entry["env_frames"] for entry in read_state(stopped.run_dir)["run"]["evaluations"]]
    assert evaluated == [entry["env_frames"] for entry in read_state(finished.run_dir)["run"]["evaluations"]]


def test_resume_drops_metrics_written_after_the_last_save(short, dot, tmp_path):
    folder = shutil.copytree(short.run_dir, tmp_path / "run")
    lines = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    lost = lines[-1].replace("60,60,12,", "75,75,18,", 1)
    assert lost != lines[-1]
    (folder / "metrics.csv").write_text("".join([*lines, lost]))  # as a run that was killed leaves the file
    resume(folder, frames=75, make_env=dot)
    assert [int(row["updates"]) for row in read_epochs(folder)] == [6, 12, 18]
    assert lost not in (folder / "metrics.csv").read_text()


def test_resume_continues_from_the_last_timed_save_after_a_crash(tiny, dot, tmp_path, monkeypatch):
    steps = itertools.count(-45 - 2 * 20 - 3 * 15)  # of the prefill, its evaluation and three rounds
    monkeypatch.setattr(saving, "SAVE_MINUTES", 0.0)
    step = {"step": lambda self, action: dot.step(self, action) if next(steps) < 5 else crash()}
    config = tiny(tmp_path / "run", evaluation={"every_frames": 10**6}, run={"frames": 105})
    with pytest.raises(Crash):
        train(config, type("Crashing", (dot,), step))
    assert (before := read_state(tmp_path / "run"))["run"]["env_frames"] == 75
    resume(tmp_path / "run", make_env=dot)
    assert_continues(before, read_state(tmp_path / "run"))


def test_run_whose_collection_process_ends_too_often_saves_itself(finished, tiny, dot, tmp_path, monkeypatch):
    rounds = itertools.count()

    class EndingWorker(LocalWorker):
        """A worker that ends with its third round, and is not replaced."""

        def result(self):
            value = super().result()
            if isinstance(value, Collected) and next(rounds) == 2:
                raise WorkerEnded("the collection process ended unexpectedly (exit code -9)")
            return value

    config = tiny(tmp_path / "run", evaluation={"every_frames": 10**6})
    with monkeypatch.context() as patch:
        patch.setattr("latentplan.training.collection.crew.LocalWorker", EndingWorker)
        with pytest.raises(UserError, match="ended unexpectedly.*--resume .* continues it"):
            train(config, dot)
    before = read_state(tmp_path / "run")
    assert before["run"]["env_frames"] == 60 and before["learner"]["updates"] > 0
    resume(tmp_path / "run", make_env=dot)
    assert_continues(before, read_state(tmp_path / "run"))


def test_resume_of_a_run_that_was_moved_does_not_look_at_its_old_folder(short, dot, tmp_path):
    folder = shutil.copytree(short.run_dir, tmp_path / "run")
    (tmp_path / "file").touch()
    save = list_saves(folder)[-1]
    config = read_config(folder / "config.yaml")
    moved = replace(config, run=replace(config.run, run_dir=str(tmp_path / "file" / "run")))
    for path in (folder, save):
        dump_config(moved, path / "config.yaml")
    seal(save)
    assert resume(folder, make_env=dot).exit_code == 0


def test_resume_removes_what_a_killed_process_left(short, dot, tmp_path):
    folder = shutil.copytree(short.run_dir, tmp_path / "run")
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    names = [f".config.yaml.{child}", f".metrics.csv.{child}", f"videos/.000000060.{child}.webm"]
    names += ["checkpoints/best/weights.safetensors.part", "checkpoints/last/manifest.json.part"]
    for name in names:
        (folder / name).write_text("half")
    (folder / "resume" / "save-000099.part").mkdir()
    (folder / "resume" / "save-000098.part").symlink_to(tmp_path)
    resume(folder, make_env=dot)
    assert not [path for path in folder.rglob("*") if path.suffix == ".part" or str(child) in path.name]
