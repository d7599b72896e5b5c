"""A run survives environments that fail, up to a budget; then it saves and stops."""

import contextlib
import csv
import json
import shutil
from functools import partial

import numpy as np
import pytest
import torch

from latentplan.commands.shell import run_guarded
from latentplan.config import EnvironmentFault, derive_seed
from latentplan.evaluation.episodes import episode_seed
from latentplan.training import resume, train
from latentplan.training.collection.collector import Collector
from latentplan.training.run import _Run
from tests.envs.faulty import Faulty
from tests.training.dot import Dot
from tests.training.run_folder import list_saves, read_state

pytestmark = pytest.mark.filterwarnings("ignore:.*its episode is cut short:RuntimeWarning")


@pytest.fixture
def faulty(tmp_path):
    """Makes the factory of an environment that fails some times."""
    (tmp_path / "faults").mkdir()
    return lambda kind, times=1: partial(Faulty, kind, tmp_path / "faults", times)


@pytest.fixture
def collect(tiny, faulty):
    """One round of 20 random decisions in an environment that fails at its third step, with the collector."""
    made = []

    def run(kind, times=1, **settings):
        collector = Collector(tiny("", collection=settings), faulty(kind, times), "cpu")
        made.append(collector)
        return collector, collector.collect(None, "random", 20, 0)

    yield run
    for collector in made:
        collector.close()


def test_replay_holds_no_transition_of_a_step_that_failed(collect):
    _, collected = collect("nan reward", short_share=0.0)
    (rows,) = collected.rows
    # Two steps, the frame before the third; then an episode of ten steps and its last frame, then seven steps.
    assert np.flatnonzero(rows.is_first).tolist() == [0, 3, 14] and len(rows.frames) == 21
    assert rows.rewards.tolist() == [1, 1, 0, *[1] * 10, 0, *[1] * 7]
    assert rows.actions[[2, 13]].tolist() == [[0.0], [0.0]] and (rows.continues == 1.0).all()
    assert np.isfinite(rows.rewards).all() and np.isfinite(rows.actions).all()
    assert (collected.memory["restarts"], collected.fault, collected.env_frames) == (1, None, 19)
    assert collected.episode_returns == [10.0]  # the episode that was cut short does not count


def test_round_that_fails_too_often_returns_what_it_collected(collect):
    _, collected = collect("exception", times=9, max_restarts=1)
    assert len(collected.rows[0].frames) == 5 and collected.decisions == 5
    assert "the lamp is out after 1 restarts (collection.max_restarts 1)" in str(collected.fault)


class Late(Faulty):
    """Fails from its first step or reset on, but not in the episode of seed 0, in which a run tries the environment."""

    def reset(self, *, seed=None, options=None):
        self.is_tried = seed == 0
        if self.kind == "reset" and seed == 0:
            self.steps, self.start = 0, 0
            return self.picture(), {}
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if self.kind != "reset" and not self.is_tried and self.is_due():
            raise ZeroDivisionError("no step")
        return super().step(action)


@pytest.mark.parametrize(("kind", "overlap"), [("reset", False), ("reset", True), ("step", False)])
def test_run_that_fails_before_its_first_decision_says_why_and_can_be_resumed(kind, overlap, tiny, dot, tmp_path):
    config = tiny(tmp_path / "run", collection={"max_restarts": 0 if kind == "step" else 1, "overlap": overlap})
    (tmp_path / "faults").mkdir()
    with pytest.raises(EnvironmentFault, match=r"no (start|step) after \d restarts .*; the run is saved in") as fault:
        train(config, partial(Late, kind, tmp_path / "faults", 99))
    assert fault.value.origin.splitlines()[-1].startswith("ZeroDivisionError: no ")
    saved = read_state(tmp_path / "run")
    assert saved["run"]["rounds"] == 0 and saved["requests"]["collect"]["counter"] == 0  # asked for again
    assert resume(tmp_path / "run", make_env=dot).exit_code == 0


@pytest.mark.parametrize(("times", "is_refused"), [(1, False), (99, True)])
def test_run_starts_unless_the_environment_fails_twice(times, is_refused, tiny, tmp_path):
    collector = Collector(tiny("", collection={"max_restarts": 5}), partial(Faulty, "reset", tmp_path, times), "cpu")
    with pytest.raises(EnvironmentFault, match="no start") if is_refused else contextlib.nullcontext():
        assert collector.describe().action_dim == 1
    collector.close()


def test_round_that_fails_too_often_ends_its_episodes(tiny, faulty, recwarn):
    collector = Collector(tiny("", collection={"max_restarts": 0}), faulty("exception", times=1), "cpu")
    weights = {name: value.numpy().copy() for name, value in collector.model.state_dict().items()}
    collected = collector.collect(weights, "actor", 20, 0)
    assert collected.fault is not None and collected.memory["has_ended"].all()
    other = Collector(tiny(""), faulty("never", times=0), "cpu")
    other.restore(collected.memory)
    (rows,) = other.collect(weights, "actor", 5, 1).rows
    collector.close(), other.close()
    assert rows.is_first.tolist() == [True, *[False] * 4] and (rows.deter[0] == 0.0).all()
    assert not [warning for warning in recwarn if "did not repeat" in str(warning.message)]


def test_evaluation_plays_an_episode_again_when_its_environment_fails(collect, tiny, tmp_path):
    collector, _ = collect("never", times=0)
    expected = collector.evaluate(2)
    other = Collector(tiny(""), partial(Faulty, "exception", tmp_path / "faults", 1), "cpu")
    other.model.load_state_dict(collector.model.state_dict())
    returns = other.evaluate(2)
    other.close()
    assert other.restarts.count == 1
    assert [len(returns[mode]) for mode in returns] == [2, 2] and returns == expected


class Brittle(Dot):
    """Fails at the third step of the episode with one seed, as often as it is played."""

    bad = episode_seed(derive_seed(0, "evaluation"), 0)

    def reset(self, *, seed=None, options=None):
        self.fails = seed == self.bad
        return super().reset(seed=seed, options=options)

    def step(self, action):
        if self.fails and self.steps == 2:
            raise ZeroDivisionError("the simulation diverged")
        return super().step(action)


@pytest.mark.filterwarnings("ignore:.*the simulation diverged:RuntimeWarning")
def test_evaluation_takes_another_start_where_the_environment_always_fails(tiny):
    collector = Collector(tiny("", collection={"max_restarts": 9}), Brittle, "cpu")
    returns = collector.evaluate(2)
    collector.close()
    assert [len(returns[mode]) for mode in returns] == [2, 2]
    assert collector.restarts.count == 4  # two tries of the planner and two of the actor


def read_metrics(folder):
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("kind", ["exception", "float frame"])
def test_run_goes_on_after_faults_and_counts_them_in_its_metrics(kind, tiny, faulty, tmp_path):
    result = train(tiny(tmp_path / "run"), faulty(kind, times=3))
    assert result.exit_code == 0 and len(read_metrics(result.run_dir)) > 0
    assert read_metrics(result.run_dir)[-1]["env_restarts"] == "3"
    state = torch.load(list_saves(result.run_dir)[-1] / "rows.pt", weights_only=True)
    assert torch.isfinite(state["rewards"]).all()


def test_restarts_count_over_the_life_of_a_run(collect, tiny, faulty, dot, tmp_path):
    _, collected = collect("exception", times=1, max_restarts=1)
    assert collected.memory["restarts"] == 1
    other = Collector(tiny("", collection={"max_restarts": 1}), partial(Faulty, "grey", tmp_path / "faults", 2), "cpu")
    with pytest.raises(EnvironmentFault, match=r"after 1 restarts \(collection.max_restarts 1\)"):
        other.restore(collected.memory)  # the running episode has seven steps, and the third fails
    other.close()
    result = train(tiny(tmp_path / "run"), faulty("text", times=3))
    assert read_metrics(result.run_dir)[-1]["env_restarts"] == "1"  # the third failure after those above
    resume(result.run_dir, frames=105, make_env=dot)
    assert read_metrics(result.run_dir)[-1]["env_restarts"] == "1"


@pytest.mark.parametrize("kind", ["exit", "hang"])
def test_run_goes_on_after_a_crash_or_a_hang_of_the_environments_process(kind, tiny, faulty, tmp_path):
    settings = {"overlap": True, "step_timeout_s": 0.5 if kind == "hang" else 60.0}
    result = train(tiny(tmp_path / "run", collection=settings), faulty(kind, times=2))
    assert result.exit_code == 0 and read_metrics(result.run_dir)[-1]["env_restarts"] == "2"


@pytest.mark.parametrize("overlap", [False, True])
def test_run_that_fails_too_often_is_saved_and_says_why(overlap, tiny, faulty, dot, tmp_path, capfd):
    folder = tmp_path / "run"
    config = tiny(folder, collection={"max_restarts": 4, "prefill_decisions": 20, "overlap": overlap})

    def command(argv):
        return train(config, faulty("exception", times=99)).exit_code

    assert run_guarded(command, []) == 2
    lines = capfd.readouterr().err.splitlines()
    first = next(index for index, line in enumerate(lines) if line.startswith("error: "))
    assert "the lamp is out after 4 restarts" in lines[first] and "the run is saved in" in lines[first]
    assert lines[first + 1] == "Traceback (most recent call last):" and "faulty.py" in lines[first + 2]
    assert lines[-1] == "ZeroDivisionError: the lamp is out"
    rows = torch.load(list_saves(folder)[-1] / "rows.pt", weights_only=True)
    assert int(rows["written"].sum()) >= 14  # the prefill until the fault is kept
    if not overlap:
        assert resume(folder, make_env=partial(Faulty, "never", tmp_path / "faults", 0)).exit_code == 0
        assert json.loads((folder / "final.json").read_text())["env_frames"] >= 90


def test_train_refuses_an_environment_whose_first_frame_is_wrong(tiny, tmp_path):
    class Grey(Faulty):
        def picture(self):
            return super().picture()[..., 0]

    with pytest.raises(EnvironmentFault, match=r"frames uint8 \(16, 16, 3\), got shape \(16, 16\)"):
        train(tiny(tmp_path / "run", collection={"max_restarts": 1}), partial(Grey, "never", tmp_path, 0))


def test_run_warns_of_black_frames(tiny, tmp_path):
    class Dark(Faulty):
        def picture(self):
            return np.zeros((16, 16, 3), np.uint8)

    with pytest.warns(RuntimeWarning, match="frames of an environment are black"):
        train(tiny(tmp_path / "run"), partial(Dark, "never", tmp_path, 0))


def test_run_whose_final_evaluation_fails_too_often_is_saved(tiny, dot, tmp_path, monkeypatch):
    def fail(self, *_):
        for save in list_saves(self.folder):
            shutil.rmtree(save)  # so that only a new save brings it back
        raise EnvironmentFault("the last lamp is out", "Traceback\n")

    monkeypatch.setattr(_Run, "_finish", fail)
    with pytest.raises(EnvironmentFault, match="the last lamp is out; the run is saved in") as fault:
        train(tiny(tmp_path / "run"), dot)
    assert fault.value.origin == "Traceback\n" and read_state(tmp_path / "run")["run"]["env_frames"] == 90
