"""When things happen in a run: collecting, evaluating, saving, stopping."""

from __future__ import annotations

import copy
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np
import torch

from latentplan.agents.checkpoint import save_checkpoint
from latentplan.config import CollectionConfig, Config
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay
from latentplan.training.collection.collector import Collected
from latentplan.training.collection.process import Worker
from latentplan.training.learner.optimization import take_up
from latentplan.training.state import INTERRUPTED, RunState, save_state

if TYPE_CHECKING:
    from latentplan.training.learner.module import Learner

SAVE_MINUTES = 5.0


class Experience(lightning.Callback):
    """Collects one round per epoch, and evaluates when it is due.

    A round is asked for when an epoch starts and taken when the next one does, so a worker in another process acts,
    with the averaged weights of its start, while the learner learns.
    """

    def __init__(self, config: Config, replay: Replay, state: RunState, worker: Worker, videos: Path) -> None:
        self.config, self.replay, self.state, self.worker, self.videos = config, replay, state, worker, videos
        self.episode_returns: list[float] = []
        self.evaluated_weights: dict[str, np.ndarray] = {}
        self._asked_evaluation: tuple[dict[str, Any], dict[str, np.ndarray]] | None = None
        self._asked_round = False

    def on_train_epoch_start(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Take what was asked for an epoch ago, and ask for what comes next."""
        settings, state = self.config.collection, self.state
        while (missing := min(settings.prefill_decisions - state.decisions, self._decisions_left())) > 0:
            self.worker.submit("collect", None, "random", missing, state.rounds)
            self._asked_round = True
            self.take()
            if state.interrupted:
                trainer.should_stop = True
                return
        weights = weights_of(learner.averaged)
        if not self._asked_round and state.rounds == state.learned_rounds:  # a run that goes on has nothing to learn
            self._ask_round(weights)
        self.take()
        if state.interrupted:
            return
        self._ask_round(weights)
        if self._asked_round and state.env_frames >= state.next_evaluation:
            self._ask_evaluation(learner.updates, weights)

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Bring the behaviour up to date before anything else looks at the learner."""
        learner.catch_up()
        if not self.state.interrupted:
            self.state.learned_rounds = self.state.rounds

    def take(self) -> None:
        """Wait for what was asked for, if anything was.

        A signal to the whole group of processes ends the one that was asked: what it owed is due again after a resume.
        """
        try:
            self._take()
        except RuntimeError:
            if not self.state.interrupted:
                raise
            self._asked_round, self._asked_evaluation = False, None

    def _take(self) -> None:
        if self._asked_round:
            self._take_round()
            self._asked_round = False
        if self._asked_evaluation is not None:
            returns = self.worker.result()
            clocks, self.evaluated_weights = self._asked_evaluation
            entry = clocks | {mode: float(np.mean(values)) for mode, values in returns.items()}
            self.state.evaluations.append(entry)
            # Only now: an evaluation that an interruption cuts off is due again.
            every = self.config.evaluation.every_frames
            self.state.next_evaluation = (entry["env_frames"] // every + 1) * every
            self._asked_evaluation = None

    def _ask_round(self, weights: dict[str, np.ndarray]) -> None:
        """Ask for the next round, if the budget has one."""
        settings, state = self.config.collection, self.state
        decisions = min(settings.round_decisions, self._decisions_left())
        if decisions > 0:
            behaviour, noisy, goal = turn(settings, state.rounds, state.env_frames)
            self.worker.submit("collect", weights, behaviour, decisions, state.rounds, noisy, goal)
            self._asked_round = True

    def _decisions_left(self) -> int:
        frames = self.config.run.frames
        if frames is None:
            return sys.maxsize
        return -(-(frames - self.state.env_frames) // self.config.env.action_repeat)

    def _ask_evaluation(self, updates: int, weights: dict[str, np.ndarray]) -> None:
        state, settings = self.state, self.config.evaluation
        clocks = {"env_frames": state.env_frames, "decisions": state.decisions, "updates": updates}
        self._asked_evaluation = clocks | {"minutes": round(state.minutes, 3)}, weights
        film = self.videos / f"{state.env_frames:09d}.webm" if settings.video else None
        self.worker.submit("evaluate", settings.episodes, film)

    def _take_round(self) -> None:
        collected: Collected = self.worker.result()
        for lane, rows in enumerate(collected.rows):
            self.replay.add(lane, rows)
        self.state.env_frames += collected.env_frames
        self.state.decisions += collected.decisions
        self.state.rounds += 1
        self.episode_returns.extend(collected.episode_returns)


def weights_of(model: WorldModel) -> dict[str, np.ndarray]:
    """A copy of a model's state, as workers take it."""
    return {name: value.detach().cpu().numpy().copy() for name, value in model.state_dict().items()}


def turn(settings: CollectionConfig, rounds: int, env_frames: int) -> tuple[str, bool, str | None]:
    """Who collects after so many rounds and simulator frames, whether with noise, and for which goal if for one.

    Planner and actor take turns in the rounds without a goal; all three share the noise evenly.
    """
    goals, share = 0, settings.goal_share
    if share > 0.0 and env_frames >= settings.goals_after:
        goals = int(rounds * share)
        if int((rounds + 1) * share) > goals:
            return "planner", True, settings.goals[goals % len(settings.goals)]
    own, behaviour = rounds - goals, settings.behaviour
    if behaviour == "both":
        own, who = divmod(own, 2)
        behaviour = ("planner", "actor")[who]
    return behaviour, True, None


class Save(lightning.Callback):
    """Keeps the last agent, the best one, and what it takes to resume."""

    def __init__(
        self,
        folder: Path,
        config: Config,
        experience: Experience,
        state: RunState,
        facts: dict[str, Any],
        optimizers: list[Any],
    ) -> None:
        self.folder, self.config, self.experience, self.state, self.facts = folder, config, experience, state, facts
        self._loaded_optimizers = optimizers
        self._kept_evaluations = len(state.evaluations)
        self._saved_minutes = state.minutes

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: Learner) -> None:  # type: ignore[override]
        """Save after every evaluation, and `SAVE_MINUTES` after the last save."""
        if self.keep_best(learner) or self.state.minutes >= self._saved_minutes + SAVE_MINUTES:
            self.save(trainer, learner)

    def keep_best(self, learner: Learner) -> bool:
        """Keep the agent of an evaluation that has come in, if it is the best; whether one has come in."""
        if len(self.state.evaluations) == self._kept_evaluations:
            return False
        self._kept_evaluations = len(self.state.evaluations)
        if (latest := self.state.evaluations[-1])["planner"] > self.state.best_return:
            self.state.best_return = latest["planner"]
            judged = copy.deepcopy(learner.averaged)
            weights = self.experience.evaluated_weights
            judged.load_state_dict({name: torch.from_numpy(value) for name, value in weights.items()})
            self.save_agent("best", judged, {name: latest[name] for name in ("env_frames", "updates", "minutes")})
        return True

    def save(self, trainer: lightning.Trainer, learner: Learner) -> None:
        """Save the last agent and the state of the run."""
        self.save_agent("last", learner.averaged, self.clocks(learner))
        self.save_run(trainer, learner)
        self._saved_minutes = self.state.minutes

    def save_run(self, trainer: lightning.Trainer, learner: Learner) -> None:
        """Save what it takes to resume."""
        optimizers = [optimizer.state_dict() for optimizer in trainer.optimizers] or self._loaded_optimizers
        saved = {"weights": learner.state_dict(), "updates": learner.updates}
        save_state(self.folder / "resume", self.state, saved, optimizers, self.experience.replay)

    def save_agent(self, name: str, model: WorldModel, info: dict[str, Any]) -> None:
        """Save an agent under a name, with facts of its own beside those of the run."""
        facts = self.facts | info | {"metrics": self.state.evaluations}
        save_checkpoint(self.folder / "checkpoints" / name, model, self.config, facts)

    def clocks(self, learner: Learner) -> dict[str, Any]:
        """Where the present agent stands."""
        return {"env_frames": self.state.env_frames, "updates": learner.updates, "minutes": self.state.minutes}


class Restore(lightning.Callback):
    """Gives the optimizers the state they were saved with, if they were."""

    def __init__(self, optimizers: list[Any]) -> None:
        self.optimizers = optimizers

    def on_fit_start(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Take up what was saved."""
        for optimizer, saved in zip(trainer.optimizers, self.optimizers, strict=True) if self.optimizers else ():
            take_up(optimizer, saved)


class Stop(lightning.Callback):
    """Ends the run at its budget, or when the user interrupts; a second Ctrl-C ends it at once."""

    def __init__(self, config: Config, state: RunState) -> None:
        self.run, self.state = config.run, state
        self._previous: dict[int, Any] = {}

    def on_train_start(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Take over the signals."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._interrupt)

    def on_train_batch_end(self, trainer: lightning.Trainer, *_: Any) -> None:  # type: ignore[override]
        """Stop between two updates when time is up or the user asks."""
        if self.state.interrupted or self._is_late():
            trainer.should_stop = True

    def on_train_epoch_end(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Stop when the last round has been learned from."""
        if self.is_spent():
            trainer.should_stop = True

    def on_train_end(self, trainer: lightning.Trainer, learner: lightning.LightningModule) -> None:
        """Give the signals back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def is_spent(self) -> bool:
        """Whether the budget of frames or minutes is used up."""
        frames = self.run.frames
        return self._is_late() or (frames is not None and self.state.env_frames >= frames)

    def _is_late(self) -> bool:
        return self.run.minutes is not None and self.state.minutes >= self.run.minutes

    def _interrupt(self, number: int, frame: Any) -> None:
        if self.state.interrupted:
            raise SystemExit(INTERRUPTED)  # Lightning would turn a KeyboardInterrupt into exit code 1
        self.state.interrupted = True
