"""The contents of a save: what no run saves is refused in one line."""

import copy
import math
import shutil

import pytest
import torch

from latentplan.config import UserError
from latentplan.config.manifest import DamageError
from latentplan.config.run_folder import run_saves
from latentplan.replay.buffer import read_saved, write_saved
from latentplan.replay.disk import read_rows
from latentplan.training import resume
from latentplan.training.state import read_state
from tests.training.run_folder import list_saves, seal, write_state
from tests.training.run_folder import read_state as read_raw_state


def put(values, path, value):
    """A copy of nested dictionaries and lists with another value at a path."""
    values = copy.deepcopy(values)
    inner = values
    for name in path[:-1]:
        inner = inner[name]
    inner[path[-1]] = value
    return values


@pytest.fixture
def folder(finished, tmp_path):
    return shutil.copytree(finished.run_dir, tmp_path / "run")


def read_again(folder, state):
    write_state(folder, state)
    return read_state(run_saves(folder).newest()[0])


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["run"], 5),
        (["run", "unknown"], 5),
        (["run", "env_frames"], True),
        (["run", "env_frames"], -1),
        (["run", "learned_rounds"], "x"),
        (["run", "evaluations"], 5),
        (["run", "evaluations"], [{"env_frames": 5}]),
        (["run", "episode_returns"], ["x"]),
        (["run", "best_return"], math.nan),
        (["run", "earlier_minutes"], math.nan),
        (["run", "earlier_minutes"], -1.0),
        (["learner"], 5),
        (["learner"], {}),
        (["learner", "weights"], []),
        (["learner", "updates"], -1),
        (["learner", "metrics"], {"loss": "x"}),
        (["optimizers"], [5]),
        (["optimizers", 0, "state"], {0: {"step": 5}}),
        (["requests"], []),
        (["requests", "collect"], {"behaviour": "planner"}),
        (["requests", "weights"], {"encoder": 5}),
        (["memory"], 5),
        (["memory", "agent"], "nobody"),
        (["memory", "belief"], {}),
        (["memory", "episodes"], [{}]),
        (["memory", "has_ended"], None),
    ],
)
def test_read_state_refuses_what_no_run_saves(folder, path, value):
    before = read_raw_state(folder)
    assert read_again(folder, before).learner["updates"] == before["learner"]["updates"]
    with pytest.raises(DamageError, match=r"state\.pt is damaged") as caught:
        read_again(folder, put(before, path, value))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["memory", "returns"], torch.zeros(3)),
        (["memory", "has_ended"], torch.zeros(1)),
        (["optimizers", 0, "param_groups"], []),
        (["optimizers", 0, "param_groups", 0, "params"], [0]),
        (["optimizers", 0, "state", 0, "exp_avg"], torch.zeros(3)),
        (["optimizers", 0, "state", 0], {"step": torch.ones(())}),
        (["requests", "weights"], {"encoder": torch.zeros(3)}),
        (["learner", "weights"], {}),
    ],
)
def test_resume_refuses_parts_that_do_not_fit_each_other(folder, dot, path, value):
    write_state(folder, put(read_raw_state(folder), path, value))
    with pytest.raises(UserError) as caught:
        resume(folder, frames=105, make_env=dot)
    assert "\n" not in str(caught.value)


def test_resume_takes_the_learning_rate_of_the_settings(folder, dot):
    state = read_raw_state(folder)
    before = state["optimizers"][0]["param_groups"][0]["lr"]
    write_state(folder, put(state, ["optimizers", 0, "param_groups", 0, "lr"], 0.5))
    resume(folder, frames=105, make_env=dot)
    assert read_raw_state(folder)["optimizers"][0]["param_groups"][0]["lr"] == before


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("written", 5),
        ("written", torch.tensor([1.5])),
        ("written", torch.tensor([10**15])),
        ("written", torch.zeros(0, dtype=torch.int64)),
        ("first", torch.tensor([-5])),
        ("first", torch.tensor([10**6])),
        ("deter", torch.zeros(3)),
        ("actions", torch.zeros(3, 1)),
        ("rewards", torch.zeros(94, 7)),
        ("episode", torch.zeros(94)),
        ("labels", torch.zeros(94, 0, dtype=torch.int64)),
        ("num_recorded", "x"),
        ("num_recorded", 10**12),
    ],
)
def test_read_rows_refuses_columns_that_do_not_fit_each_other(folder, name, value):
    save = list_saves(folder)[-1]
    rows = torch.load(save / "rows.pt", weights_only=True)
    write_saved(rows | {name: value}, save / "rows.pt")
    seal(save)
    with pytest.raises(DamageError, match=r"rows\.pt is damaged") as caught:
        read_rows(run_saves(folder).newest()[0], 0)
    assert "\n" not in str(caught.value)


def test_read_saved_refuses_every_error_of_the_unpickler(tmp_path, monkeypatch):
    write_saved({"a": torch.ones(3)}, tmp_path / "file")
    assert torch.equal(read_saved(tmp_path / "file", keys={"a": torch.Tensor})["a"], torch.ones(3))

    def fail(*_, **__):
        raise AssertionError("of the unpickler")

    monkeypatch.setattr(torch, "load", fail)
    with pytest.raises(DamageError, match="file is damaged: of the unpickler"):
        read_saved(tmp_path / "file")
