"""Steps that are not finite: skipped, counted, kept; ten in a row go back to the last save or stop the run."""

import warnings
import weakref

import pytest
import torch

from latentplan.replay.buffer import Replay
from latentplan.training import resume, saving, train
from latentplan.training.learner.curriculum import Curriculum
from latentplan.training.learner.skips import NotFiniteError
from tests.training.run_folder import list_saves, read_rows, read_state


def poison(monkeypatch, is_poisoned):
    """Makes the rewards of chosen batches NaN; `is_poisoned` takes the number of batches so far."""
    unchanged, count = Curriculum.__call__, [0]

    def prepare(curriculum, batch):
        count[0] += 1
        batch = unchanged(curriculum, batch)
        return batch._replace(rewards=batch.rewards * torch.nan) if is_poisoned(count[0] - 1) else batch

    monkeypatch.setattr(Curriculum, "__call__", prepare)
    return count


def test_run_skips_counts_and_keeps_a_batch_that_is_not_finite(tiny, dot, tmp_path, monkeypatch):
    poison(monkeypatch, lambda count: count in (3, 8))
    with pytest.warns(RuntimeWarning, match=r"by update \d+: a step was skipped, and its batch is kept in"):
        run = train(tiny(tmp_path / "run"), dot)
    assert run.exit_code == 0
    state = read_state(run.run_dir)
    weights = state["learner"]["weights"]
    assert [int(weights[f"skips.{half}.total"]) for half in (0, 1)] == [2, 2] and state["learner"]["updates"] == 24
    assert all(value.isfinite().all() for value in state["learner"]["weights"].values())
    kept = sorted((run.run_dir / "skipped").iterdir())
    assert sorted(path.name.partition("-")[0] for path in kept) == ["behaviour"] * 2 + ["model"] * 2
    batch = torch.load(kept[-1], weights_only=True)
    assert batch["frames"].shape == (4, 6, 64, 64, 3) and batch["rows"].dtype == torch.long
    assert [row["skipped_steps"] for row in read_rows(run.run_dir) if row["reconstruction"]] == ["2", "4", "4", "4"]


def test_run_goes_back_to_its_last_save_after_ten_skipped_steps(tiny, dot, tmp_path, monkeypatch):
    more = {"updates_per_decision": 1.0}  # 15 updates per epoch, so that the ten lie in one
    whole = train(tiny(tmp_path / "whole", collection=more), dot)
    count = poison(monkeypatch, lambda count: 15 <= count < 25)  # not again when the batches are drawn again
    monkeypatch.setattr(saving, "SAVE_MINUTES", 0.0)
    made, alive, make = [], [], Replay.__init__

    def watch(replay, *sizes, **more):
        alive.append(sum(each() is not None for each in made))
        made.append(weakref.ref(replay))
        make(replay, *sizes, **more)

    monkeypatch.setattr(Replay, "__init__", watch)
    with pytest.warns(RuntimeWarning, match=r"in 10 steps in a row, up to update 25.*goes back to its last save"):
        run = train(tiny(tmp_path / "run", collection=more), dot)
    assert alive == [0, 0]  # two replays at once may not fit into the memory
    assert run.exit_code == 0 and count[0] == 60 + 10
    weights = [read_state(folder)["learner"]["weights"] for folder in (whole.run_dir, run.run_dir)]
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())


def test_run_stops_with_the_reason_when_the_same_steps_are_skipped_again(tiny, dot, tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "SAVE_MINUTES", 0.0)
    with monkeypatch.context() as patch:
        poison(patch, lambda count: count >= 8)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with pytest.raises(NotFiniteError, match="10 steps in a row.*lower learning rate") as caught:
                train(tiny(tmp_path / "run"), dot)
    assert "\n" not in str(caught.value)
    assert len(list((tmp_path / "run" / "skipped").iterdir())) <= saving.KEPT_BATCHES
    assert list_saves(tmp_path / "run") and resume(tmp_path / "run", make_env=dot).exit_code == 0


def test_run_learns_from_the_rest_when_one_row_of_replay_is_not_finite(tiny, dot, tmp_path, monkeypatch):
    add = Replay.add

    def add_poisoned(replay, lane, rows):
        if replay.written[lane] == 0:
            rows.rewards[4] = float("nan")
        add(replay, lane, rows)

    monkeypatch.setattr(Replay, "add", add_poisoned)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = train(tiny(tmp_path / "run"), dot)
    skipped = int(read_state(run.run_dir)["learner"]["weights"]["skips.0.total"])
    assert run.exit_code == 0 and 0 < skipped < 24
