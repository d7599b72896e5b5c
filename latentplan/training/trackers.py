"""Experiment trackers of a run: scalars, films and strips of films, in as many trackers as the user names."""

from __future__ import annotations

import contextlib
import os
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from latentplan.config import Config, to_dict
from latentplan.config.extras import import_extra
from latentplan.config.reading import read_text
from latentplan.config.settings import by_key
from latentplan.config.writing import write_whole
from latentplan.reporting.frame import Frame
from latentplan.reporting.report import tile
from latentplan.reporting.video import encode_gif, read_frames

PROJECT = "latentplan"
FILM, STRIP = "evaluation/film", "evaluation/strip"
STRIP_FRAMES = 6
GIF_FRAMES = 40
GIF_MS = 100


class TrackioLogger(Logger):
    """Sends metrics to trackio, whose runs lie in a local database unless its own settings say otherwise.

    Args:
        name: Name of the run; a resumed run of the same name goes on.
        config: Settings of the run.
    """

    def __init__(self, name: str, config: Mapping[str, Any]) -> None:
        super().__init__()
        self._name = name
        self.trackio = import_extra("trackio", "the logger trackio")
        self.experiment = self.trackio.init(project=PROJECT, name=name, config=dict(config), resume="allow")

    @property
    def name(self) -> str:
        """Name of the project."""
        return PROJECT

    @property
    def version(self) -> str:
        """Name of the run."""
        return self._name

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Add a row of numbers."""
        self.experiment.log(dict(metrics), step=step)

    def log_hyperparams(self, params: dict[str, Any] | Namespace, *args: Any, **kwargs: Any) -> None:
        """Does nothing: the settings were given when the run began."""


class Trackers:
    """The trackers of a run. A tracker that fails is dropped with a warning, and the run goes on without it.

    Args:
        names: Names in `LOGGERS` of `latentplan.config.settings`.
        folder: Folder of the run.
        config: Settings of the run.
        run_id: Identifies the run in trackers that keep runs by number, also after it is resumed.
    """

    def __init__(self, names: Sequence[str], folder: Path, config: Config, run_id: str) -> None:
        self.loggers: list[Logger] = []
        self._folder, self._config, self._id = folder, config, run_id
        for name in names:
            with self._guard(name):
                self.loggers.append(self._make(name))

    def log(self, row: Mapping[str, float], step: int) -> None:
        """Add a row of numbers to every tracker."""
        self._each(lambda logger: logger.log_metrics(dict(row), step=step))

    def log_film(self, path: Path, step: int) -> None:
        """Add a film and a strip of its frames to every tracker that shows pictures; without a film nothing happens."""
        shows = [logger for logger in self.loggers if not isinstance(logger, CSVLogger)]
        if not path.exists() or not shows:
            return
        try:
            frames = read_frames(path, GIF_FRAMES)
        except OSError as error:
            warnings.warn(f"no film in the trackers: {error}", RuntimeWarning, stacklevel=2)
            return
        places = np.linspace(0, len(frames) - 1, min(STRIP_FRAMES, len(frames))).astype(int)
        strip = tile(np.array_split(np.stack([frames[place] for place in places]), 2))
        self._each(lambda logger: _log_film(logger, path, frames, strip, step))

    def close(self, is_complete: bool) -> None:
        """End the runs of trackers, which show whether a run is complete, stopped or failed."""
        self._each(lambda logger: _finish(logger, is_complete))

    def _each(self, call: Callable[[Logger], Any]) -> None:
        for logger in list(self.loggers):
            with self._guard(type(logger).__name__, logger):
                call(logger)

    @contextlib.contextmanager
    def _guard(self, name: str, logger: Logger | None = None) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # trackers raise errors of any type, such as those of their network
            if logger is not None:
                self.loggers.remove(logger)
            reason = " ".join(str(error).split())[:200]
            warnings.warn(f"{name} gets nothing more of this run: {reason}", RuntimeWarning, stacklevel=3)

    def _make(self, name: str) -> Logger:
        folder, run = self._folder, self._folder.resolve().name
        settings = by_key(to_dict(self._config))
        if name == "csv":
            return CSVLogger(folder, name="csv", flush_logs_every_n_steps=1)  # a new version at every start
        if name == "wandb":
            import_extra("wandb", "the logger wandb")
            return WandbLogger(name=run, save_dir=folder, project=PROJECT, id=self._id, config=settings)
        if name == "trackio":
            return TrackioLogger(f"{run}-{self._id}", settings)
        if name == "mlflow":
            import_extra("mlflow", "the logger mlflow")
            return _make_mlflow(run, folder, settings)
        return TensorBoardLogger(folder, name="tensorboard", version="")


def _make_mlflow(run: str, folder: Path, settings: Mapping[str, Any]) -> MLFlowLogger:
    """The logger of MLflow: of the server in MLFLOW_TRACKING_URI, or of a database in the folder of the run."""
    noted = folder / "mlflow-run.txt"
    known = read_text(noted).strip() if noted.exists() else None
    address = os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{(folder / 'mlflow.db').resolve()}"
    place = None if "MLFLOW_TRACKING_URI" in os.environ else str((folder / "mlflow").resolve())
    logger = MLFlowLogger(PROJECT, run_name=run, tracking_uri=address, run_id=known, artifact_location=place)
    if known is None:
        logger.log_hyperparams(dict(settings))
        write_whole(noted, str(logger.run_id))
    return logger


def _log_film(logger: Logger, path: Path, frames: list[Frame], strip: Frame, step: int) -> None:
    if isinstance(logger, TensorBoardLogger):
        from tensorboard.compat.proto.summary_pb2 import Summary

        logger.experiment.add_image(STRIP, strip, step, dataformats="HWC")
        gif, (height, width) = encode_gif(frames, GIF_MS)
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
        writer = logger.experiment._get_file_writer()
        writer.add_summary(Summary(value=[Summary.Value(tag=FILM, image=image)]), step)
    elif isinstance(logger, WandbLogger):
        logger.log_image(STRIP, [strip], step=step)
        logger.log_video(FILM, [str(path)], step=step, format=["webm"])
    elif isinstance(logger, TrackioLogger):
        trackio = logger.trackio
        logger.experiment.log({STRIP: trackio.Image(strip), FILM: trackio.Video(str(path), format="webm")}, step=step)
    elif isinstance(logger, MLFlowLogger):
        logger.experiment.log_artifact(logger.run_id, str(path), "films")
        logger.experiment.log_image(logger.run_id, strip, f"strips/{step:09d}.png")


def _finish(logger: Logger, is_complete: bool) -> None:
    if isinstance(logger, WandbLogger):
        logger.experiment.finish(exit_code=0 if is_complete else 1)
    elif isinstance(logger, TrackioLogger):
        logger.experiment.finish()
    else:
        logger.finalize("success" if is_complete else "failed")
