"""metrics.csv and TensorBoard: every loss becomes a column, also when a run resumes with other losses."""

import csv
from types import SimpleNamespace

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from latentplan.config import Config
from latentplan.training.callbacks import COLUMNS, MetricsFile, Record
from latentplan.training.state import RunState
from latentplan.training.trackers import Trackers


def read_table(path):
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        return list(reader), tuple(reader.fieldnames)


@pytest.fixture
def file(tmp_path):
    return MetricsFile(tmp_path / "metrics.csv", ("updates", "minutes"))


def test_metrics_file_begins_with_its_columns_and_adds_new_names_at_the_end(file):
    file.append({"updates": 1, "minutes": 0.5})
    file.append({"minutes": 1.0, "reward": 0.25, "updates": 2, "value": 3.0})
    rows, header = read_table(file.path)
    assert header == ("updates", "minutes", "reward", "value")
    assert rows[0] == {"updates": "1", "minutes": "0.5", "reward": "", "value": ""}
    assert rows[1] == {"updates": "2", "minutes": "1.0", "reward": "0.25", "value": "3.0"}


def test_metrics_file_keeps_figures_of_earlier_columns_when_losses_come_and_go(file):
    file.append({"updates": 1, "removed": 0.1234567890123})
    resumed = MetricsFile(file.path, file.columns)
    resumed.append({"updates": 2, "added": 7.0})
    rows, header = read_table(file.path)
    assert header == ("updates", "minutes", "removed", "added")
    assert [(row["removed"], row["added"]) for row in rows] == [("0.1234567890123", ""), ("", "7.0")]


def test_record_writes_each_metric_of_the_learner_to_csv_and_tensorboard(tmp_path):
    """The header orders losses as the learner does, and gradient norms after them."""
    state = RunState(env_frames=30, decisions=15, earlier_minutes=2.0, episode_returns=[4.0, 6.0])
    collect = SimpleNamespace(is_epoch_over=True, env_restarts=2)
    trackers = Trackers(("tensorboard",), tmp_path, Config(), "id")
    record = Record(tmp_path / "metrics.csv", state, collect, SimpleNamespace(episode_return=None), trackers)
    names = ("reconstruction", "model_grad_norm", "surprise", "behaviour_grad_norm")
    metrics = {name: torch.tensor(float(place)) for place, name in enumerate(names)}
    learner = SimpleNamespace(updates=7, metrics=metrics, skips=())
    record.on_train_epoch_end(SimpleNamespace(), learner)
    trackers.close(is_complete=True)
    ((row,), header) = read_table(tmp_path / "metrics.csv")
    losses = ("reconstruction", "surprise", "model_grad_norm", "behaviour_grad_norm")
    assert header == (*COLUMNS, *losses, "env_restarts") and row["env_restarts"] == "2"
    assert (row["env_frames"], row["updates"], row["episode_return"]) == ("30", "7", "5.0")
    assert [float(row[name]) for name in names] == [0.0, 1.0, 2.0, 3.0]
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert {*names, "env_frames", "episode_return"} <= set(events.Tags()["scalars"])
    assert events.Scalars("surprise")[0].value == 2.0
