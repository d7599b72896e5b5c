"""Trackers get scalars and films, several at once; one that fails is dropped and the run goes on."""

import csv

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from latentplan.config import Config, RunConfig, UserError
from latentplan.config.extras import EXTRAS
from latentplan.config.settings import LOGGERS
from latentplan.reporting.video import VideoWriter, encode_gif, read_frames
from latentplan.training.checks import check_settings
from latentplan.training.trackers import FILM, STRIP, Trackers


@pytest.fixture
def film(tmp_path):
    path = tmp_path / "film.webm"
    with VideoWriter(path, 20.0, (32, 16)) as writer:
        for index in range(12):
            writer.write(np.full((16, 32, 3), 20 * index, np.uint8))
    return path


def test_several_trackers_get_the_same_scalars(tmp_path, film):
    trackers = Trackers(("tensorboard", "csv"), tmp_path, Config(), "id")
    trackers.log({"reward": 2.0}, step=10)
    trackers.log_film(film, step=10)
    trackers.close(is_complete=True)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(each.step, each.value) for each in events.Scalars("reward")] == [(10, 2.0)]
    assert {FILM, STRIP} <= set(events.Tags()["images"])
    assert events.Images(FILM)[0].encoded_image_string.startswith(b"GIF8")
    with (tmp_path / "csv" / "version_0" / "metrics.csv").open(newline="") as file:
        assert [(row["step"], row["reward"]) for row in csv.DictReader(file)] == [("10", "2.0")]


def test_a_tracker_that_fails_is_dropped_with_one_warning(tmp_path):
    trackers = Trackers(("tensorboard", "csv"), tmp_path, Config(), "id")
    broken = trackers.loggers[0]
    broken.log_metrics = lambda *_, **__: 1 / 0
    with pytest.warns(RuntimeWarning, match="TensorBoardLogger gets nothing more") as caught:
        trackers.log({"reward": 2.0}, step=10)
        trackers.log({"reward": 3.0}, step=20)
    assert len(caught) == 1 and broken not in trackers.loggers
    trackers.close(is_complete=True)
    assert len((tmp_path / "csv" / "version_0" / "metrics.csv").read_text().splitlines()) == 3


def test_rows_of_csv_are_on_the_disk_at_once_and_stay_when_the_run_is_resumed(tmp_path):
    for start in range(2):
        Trackers(("csv",), tmp_path, Config(), "id").log({"reward": float(start)}, step=10)  # not closed
    rows = [row for file in sorted(tmp_path.rglob("metrics.csv")) for row in csv.DictReader(file.open(newline=""))]
    assert [row["reward"] for row in rows] == ["0.0", "1.0"]


def test_a_film_that_cannot_be_read_is_left_out_with_a_warning(tmp_path):
    (tmp_path / "film.webm").write_bytes(b"no film")
    trackers = Trackers(("tensorboard",), tmp_path, Config(), "id")
    with pytest.warns(RuntimeWarning, match="no film in the trackers"):
        trackers.log_film(tmp_path / "film.webm", step=10)
    assert len(trackers.loggers) == 1


def test_read_frames_takes_the_first_and_the_last_frame_of_a_film(film):
    frames = read_frames(film, 3)
    assert [round(frame.mean() / 20) for frame in frames] == [0, 6, 11]
    gif, size = encode_gif(frames, 100)
    assert size == (8, 16) and gif.startswith(b"GIF8")


def test_every_tracker_that_is_not_core_has_an_extra_of_its_name():
    assert set(LOGGERS) - set(EXTRAS) == {"tensorboard", "csv"}


def test_an_unknown_tracker_and_one_that_is_not_installed_are_refused(monkeypatch):
    with pytest.raises(ValueError, match="logger must be of tensorboard, csv.*got 'tensorbord'"):
        RunConfig(logger=("tensorbord",))
    monkeypatch.setattr("latentplan.config.extras.util.find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"logger wandb needs wandb.*latentplan\[wandb\]"):
        check_settings(Config(run=RunConfig(frames=10, logger=("csv", "wandb"))))
