"""What a run writes down as it goes: metrics.csv, TensorBoard events, the line on the screen."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np

from latentplan.training.callbacks import Experience
from latentplan.training.state import RunState

if TYPE_CHECKING:
    from latentplan.training.console import Progress
    from latentplan.training.learner.module import Learner

COLUMNS = (
    *("env_frames", "decisions", "updates", "minutes", "episode_return"),
    *("planner_return", "actor_return", "planner_minus_actor"),
    *(
        "reconstruction",
        "reward",
        "open_loop_reward",
        "continue",
        "dynamics",
        "representation",
        "overshooting",
        "probe",
    ),
    *("actor", "imitation", "value", "imagined_return", "entropy", "model_grad_norm", "behaviour_grad_norm"),
)


class Record(lightning.Callback):
    """Writes metrics.csv and TensorBoard once per epoch, and shows progress."""

    def __init__(self, path: Path, state: RunState, experience: Experience, progress: Progress) -> None:
        self.path, self.state, self.experience, self.progress = path, state, experience, progress
        self._shown_evaluations = len(state.evaluations)

    def on_fit_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Drop the rows that a killed run wrote after its last save: they are about to be written again."""
        if not self.path.exists():
            return
        with self.path.open(newline="") as file:
            rows = [row for row in csv.DictReader(file) if None not in row.values()]
        with self.path.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            clocks = {"env_frames": self.state.env_frames, "updates": learner.updates}
            writer.writerows(row for row in rows if all(int(row[name]) <= now for name, now in clocks.items()))

    def on_train_batch_end(self, trainer: lightning.Trainer, learner: Learner, *_: Any) -> None:  # type: ignore[override]
        """Move the progress display on."""
        self.progress.update(self.state, learner.updates)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Append one row for the epoch, after those of the evaluations that came in."""
        self.write_evaluations(trainer)
        state = self.state
        row: dict[str, float] = {name: float(value) for name, value in learner.metrics.items()}
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": learner.updates}
        row |= clocks | {"minutes": round(state.minutes, 3)}
        if self.experience.episode_returns:
            row["episode_return"] = float(np.mean(self.experience.episode_returns))
            self.progress.episode_return = row["episode_return"]
            self.experience.episode_returns.clear()
        self._append(trainer, row)

    def write_evaluations(self, trainer: lightning.Trainer) -> None:
        """Append one row for each new evaluation, with the clocks of the weights that were judged."""
        for entry in self.state.evaluations[self._shown_evaluations :]:
            clocks = {name: entry[name] for name in ("env_frames", "decisions", "updates", "minutes")}
            returns = {"planner_return": entry["planner"], "actor_return": entry["actor"]}
            self._append(trainer, clocks | returns | {"planner_minus_actor": entry["planner"] - entry["actor"]})
            self.progress.show_evaluation(entry)
        self._shown_evaluations = len(self.state.evaluations)

    def _append(self, trainer: lightning.Trainer, row: dict[str, float]) -> None:
        if trainer.logger is not None:
            trainer.logger.log_metrics(row, step=int(row["env_frames"]))
        is_new = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if is_new:
                writer.writeheader()
            writer.writerow(row)
