"""A training run, from its settings to its final evaluation."""

from __future__ import annotations

import contextlib
import errno
import json
import shlex
import sys
import uuid
import warnings
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning
import numpy as np
import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException

from latentplan.agents.checkpoint import INFO, load_model
from latentplan.agents.files import is_checkpoint
from latentplan.config import USER_DOMAIN, Config, Device, Strategy, UserError, derive_seed
from latentplan.config.commit import Save
from latentplan.config.env_id import as_file_name, repeat_flag
from latentplan.config.estimates import choose_threads
from latentplan.config.files import dump_config, read_config
from latentplan.config.origin import present_facts
from latentplan.config.run_folder import CHECKPOINTS, RUN_FILE, SAVES_FOLDER, lock_folder, read_run_config, run_saves
from latentplan.config.run_results import FINAL_FILE, METRICS_FILE, note_state, read_facts
from latentplan.config.writing import write_whole
from latentplan.envs import default_task
from latentplan.models import WorldModel
from latentplan.models.fast import accelerate
from latentplan.replay.buffer import Replay
from latentplan.replay.dealing import DealtRows, count_ranks
from latentplan.replay.disk import Counts, ReplayFiles, count_saved
from latentplan.training.callbacks import Collect, Record, agree_on_signals, copy_weights
from latentplan.training.checks import check_folder, check_settings
from latentplan.training.collection.collector import Description, EnvFactory
from latentplan.training.collection.crew import Worker, check_memory, make_worker
from latentplan.training.collection.episodes import Stopped, to_arrays
from latentplan.training.collection.keeping import begin_keeping, check_kept, keep_alone
from latentplan.training.collection.process import WorkerEnded
from latentplan.training.console import Progress, own_command
from latentplan.training.demonstrations.seeding import count_rows, read_demonstrations, seed_replay
from latentplan.training.estimates import count_replay_rows
from latentplan.training.facts import agent_facts, describe_change, describe_run, meet_ranks, write_report
from latentplan.training.learner.batches import ReplayBatches, ReplayData
from latentplan.training.learner.curriculum import Curriculum
from latentplan.training.learner.graphed import make_learner
from latentplan.training.learner.skips import NotFiniteError
from latentplan.training.ranks import Ranks, join_ranks, place_ranks
from latentplan.training.resources import choose_device, keep_threads, make_trainer, set_up_torch
from latentplan.training.saving import Guard, Restore, Stop, name_save
from latentplan.training.saving import Save as SaveRun
from latentplan.training.signals import Signals, exit_code
from latentplan.training.state import (
    RunState,
    SavedRun,
    read_saved_run,
    refuse_used,
    remove_leftovers,
    restore_learner,
    restore_metrics,
    warn_of_loss,
)
from latentplan.training.trackers import Trackers

if TYPE_CHECKING:
    from collections.abc import Mapping

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)  # of which some do not name a file


@dataclass(frozen=True)
class Result:
    """The folder, exit code and summary of a run that ended.

    Attributes:
        run_dir: Folder of the run.
        exit_code: 0; 128 and the number of a signal that interrupted the run (130 Ctrl-C, 143 SIGTERM, 129 SIGHUP).
        summary: Mean return of the final evaluation per mode; empty when interrupted.
    """

    run_dir: Path
    exit_code: int
    summary: Mapping[str, float]


def train(config: Config, make_env: EnvFactory | None = None) -> Result:
    """Trains an agent to control a body from pixels.

    Args:
        config: Settings of the run.
        make_env: Makes the user's own `gymnasium.Env`, with spaces that `latentplan.envs.accept_spaces` accepts; None
            makes the suite's task that `config.env` names.

    Returns:
        The folder, exit code and summary of the run. Where several processes learn together, each runs the calling
        program up to here, and only the first one gets a summary.

    Raises:
        UserError: The settings, the environment or the machine do not allow the run.
    """
    if config.run.frames is None and config.run.minutes is None and config.run.updates is None:
        raise UserError("a run needs an end: give --frames, --minutes or --updates")
    domain, task = config.env.domain, config.env.task
    if make_env is not None:
        if config.env.objective is not None:
            raise UserError(
                "env.objective needs a domain of the suite; an environment of your own returns its own reward"
            )
        domain, task = USER_DOMAIN, getattr(make_env, "__name__", type(make_env).__name__)
    config = replace(
        config, env=replace(config.env, domain=domain, task=task or default_task(domain, config.env.suite))
    )
    if config.run.run_dir is None:
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        name = as_file_name(f"{config.env.domain}-{config.env.task}-seed{config.run.seed}-{stamp}")
        config = replace(config, run=replace(config.run, run_dir=str(Path("runs") / name)))
    check_folder(str(config.run.run_dir))
    folder = Path(str(config.run.run_dir))
    refuse_used(folder, "run", "--run-dir")
    return _start(begin_keeping(config), folder, make_env, resume=False)


def resume(
    run_dir: Path | str,
    *,
    frames: int | None = None,
    minutes: float | None = None,
    updates: int | None = None,
    device: Device | None = None,
    devices: int | None = None,
    nodes: int | None = None,
    strategy: Strategy | None = None,
    ray_address: str | None = None,
    make_env: EnvFactory | None = None,
) -> Result:
    """Continues a run from its last save: weights, optimizers, replay, clocks, random streams and running episodes.

    If the last save is damaged, the run continues from the save before, and a warning names the damage and the loss. A
    new budget or device is written to the run's settings, so later resumptions keep it.

    Args:
        run_dir: Folder of the run.
        frames: New total budget of frames. If `frames`, `minutes` and `updates` are all None, the old budget stays.
        minutes: New total budget of minutes.
        updates: New total budget of updates.
        device: New device; None keeps the old device.
        devices: New number of learning processes on each machine; None keeps the old number. Another number deals the
            rows of all replays anew, and running episodes begin again.
        nodes: New number of machines; None keeps the old number.
        strategy: How several processes learn together; None keeps it.
        ray_address: New address of the Ray cluster; None keeps the old address.
        make_env: Makes the user's environment, as for `train`.

    Returns:
        The folder, exit code and summary of the run.

    Raises:
        UserError: The folder holds no run that can be resumed.
    """
    folder = Path(run_dir)
    config, warning = read_run_config(folder)
    if warning:
        warnings.warn(warning, RuntimeWarning, stacklevel=2)
    if config.env.task is None:  # `train` always writes the task
        raise UserError(f"{folder / RUN_FILE} is damaged: it does not say what the task is")
    if config.env.domain == USER_DOMAIN and make_env is None:
        raise UserError("this run learns in your own environment: resume it from Python, with make_env")
    run = config.run
    if frames is not None or minutes is not None or updates is not None:
        run = replace(run, frames=frames, minutes=minutes, updates=updates)
    given = {"device": device, "devices": devices, "nodes": nodes, "strategy": strategy, "ray_address": ray_address}
    run = replace(run, **{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
    return _start(replace(config, run=run), folder, make_env, resume=True)


def _start(config: Config, folder: Path, make_env: EnvFactory | None, *, resume: bool) -> Result:
    """Runs with all ranks until the end, an interruption or an error."""
    config = place_ranks(config)
    check_settings(replace(config, run=replace(config.run, run_dir=str(folder))), is_new=not resume)
    with contextlib.closing(join_ranks(config)) as ranks:
        config, folder = ranks.lead(lambda: (config, folder))
        take_part = _lead if ranks.is_first else _follow
        return take_part(config, folder, make_env, ranks, resume=resume)


def _lead(config: Config, folder: Path, make_env: EnvFactory | None, ranks: Ranks, *, resume: bool) -> Result:
    """Runs as rank 0, which keeps the folder."""
    with lock_folder(folder), keep_alone(config.collection.keep_episodes), Signals() as signals:
        remove_leftovers(folder)
        facts = present_facts(config.run.device != "cpu" and torch.cuda.is_available())
        run_id = read_facts(folder).get("run_id") or uuid.uuid4().hex[:8]
        note_state(folder, "running", run_id=run_id, command=shlex.join(sys.argv), **facts)
        try:
            meet_ranks(ranks, folder, run_id)
            result = _run_until_end(config, folder, make_env, signals, ranks, resume=resume)
            ranks.together(lambda: None)
        except BaseException as error:
            with contextlib.suppress(OSError):  # a full disk may be the reason
                note_state(folder, "failed", reason=" ".join(str(error).split()) or type(error).__name__)
            raise
        note_state(folder, "finished" if result.exit_code == 0 else "stopped")
        return result


def _follow(config: Config, folder: Path, make_env: EnvFactory | None, ranks: Ranks, *, resume: bool) -> Result:
    """Runs as a rank above 0, until all ranks end; rank 0 alone reports errors, and its exit code counts.

    Lightning would kill all processes if this one ended with another exit code than 0.
    """
    try:
        with Signals() as signals:
            meet_ranks(ranks, folder)
            _run_until_end(config, folder, make_env, signals, ranks, resume=resume)
            ranks.together(lambda: None)
    except (UserError, NotFiniteError):
        raise SystemExit(0) from None
    return Result(folder, 0, {})


def _run_until_end(
    config: Config, folder: Path, make_env: EnvFactory | None, signals: Signals, ranks: Ranks, *, resume: bool
) -> Result:
    failed_at = -1
    while True:
        signals.forget_listener()  # a run that was given up, whose replay would stay in memory
        try:
            with keep_threads():
                return _Run(config, folder, make_env, signals, ranks, resume=resume).execute()
        except NotFiniteError as error:
            if error.update <= failed_at:
                raise  # the same again: another try would end here too
            failed_at, resume = error.update, True
            if ranks.is_first:
                warnings.warn(f"{error}: the run goes back to its last save", RuntimeWarning, stacklevel=3)
        except Stopped:  # while the run was being set up, from which nothing is lost
            return Result(folder, exit_code(ranks.largest(signals.received)), {})
        except WorkerEnded as error:
            raise UserError(f"{error}; the run has stopped, and --resume {folder} continues it") from error
        except OSError as error:
            is_own = str(error.filename or "").startswith(str(folder))
            if not is_own and error.errno not in DISK_ERRORS:
                raise
            raise UserError(
                f"the run in {folder} has stopped: {error.strerror} ({error.filename or 'while writing'}); "
                f"when this is mended, --resume {folder} continues from its last save"
            ) from error


class _Run:
    """A run with its worker, replay, learner, curriculum and display."""

    def __init__(
        self,
        config: Config,
        folder: Path,
        make_env: EnvFactory | None,
        signals: Signals,
        ranks: Ranks,
        *,
        resume: bool,
    ) -> None:
        self.config, self.folder, self.signals, self.ranks = config, folder, signals, ranks
        self.trackers: Trackers | None = None
        self.saves = run_saves(folder)
        save = ranks.lead(self._find_save) if resume else None
        self.demonstrations = [] if resume else read_demonstrations(config, make_env)
        self.device = choose_device(config.run, ranks.device)
        self.console = Progress(config.run, is_quiet=not ranks.is_first)
        set_up_torch(config.run.threads or choose_threads(config.local_collectors, config.run.devices), self.device)
        own = ranks.own_config(config)
        self.worker: Worker = make_worker(own, make_env, self.device, lambda: signals.received > 0)
        try:
            self.worker.submit("describe")
            self.description: Description = ranks.together(self.worker.result)[ranks.rank]
            self._build(save)
        except BaseException:
            self.worker.close()
            raise

    def _find_save(self) -> Save:
        """The newest save that is whole; warns of newer ones that are not."""
        save, problems = self.saves.newest()
        warn_of_loss(save, problems)
        check_kept(self.config, self.saves.find(RUN_FILE), has_other_ranks=count_ranks(save) != self.ranks.size)
        return save

    def _build(self, save: Save | None) -> None:
        config, ranks = self.config, self.ranks
        saved: SavedRun | None = None if save is None else read_saved_run(save, ranks)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(config.run.seed, "weights"))
            facts = self.description
            model = WorldModel(config.model, facts.action_dim, facts.labels, spaces=facts.spaces).to(self.device)
        accelerate(model)
        replay_device = self.device if config.replay.on_device else torch.device("cpu")
        recorded = count_rows(self.demonstrations, config.learning.sequence_length, ranks.rank, ranks.size)
        saved_rows, dealt = Counts(0, 0, recorded), None
        if save is not None:
            if (before := count_ranks(save)) != ranks.size:
                dealt = DealtRows(save, ranks.rank, ranks.size)
                self.console.console.print(describe_change(before, ranks.size), soft_wrap=True)
            saved_rows = count_saved(save, ranks.rank) if dealt is None else dealt.counts
        self.replay = Replay(
            count_replay_rows(config, saved_rows.num_lanes * saved_rows.lane_rows),
            model.action_dim,
            config.model.deter_dim,
            config.num_lanes,
            replay_device,
            len(model.labels) + model.spaces.vector_dim,
            model.spaces.frame_shape,
            saved_rows.recorded_rows,
        )
        self.files = ReplayFiles(self.folder / SAVES_FOLDER, self.replay, ranks.rank)
        self.saved, self.state = saved, RunState() if saved is None else saved.state
        self.signals.receive = self._interrupt
        self._interrupt(self.signals.received)
        self.curriculum = Curriculum(config, model.labels, self.state)
        self.learner = make_learner(model, config, self.description.discount, self.replay, self.curriculum, ranks)
        if save is not None and saved is not None:
            check_memory(saved.memory, config, self.folder)
            self.files.read(save) if dealt is None else dealt.fill(self.replay)
            restore_learner(self.learner, saved.learner, self.folder, saved.requests["weights"])
            if ranks.is_first:
                restore_metrics(save, self.folder)
        else:
            seed_replay(self.replay, self.demonstrations, ranks.rank, ranks.size)
        has_seen_end = saved is not None and saved.has_seen_end
        if has_seen_end or self.replay.has_recorded_end:
            self.worker.submit("notice_end")
            self.worker.result()

    def _interrupt(self, number: int) -> None:
        self.state.received = number
        if self.ranks.size == 1:  # several ranks agree later, all at the same time
            self.state.interrupted = number

    def execute(self) -> Result:
        """Learn until the budget is spent or a signal arrives, then evaluate."""
        is_complete = False
        try:
            result = self._execute()
            is_complete = result.exit_code == 0
            return result
        finally:
            if self.trackers is not None:
                self.trackers.close(is_complete)
            self.worker.close()

    def _execute(self) -> Result:
        config, saved, state, ranks = self.config, self.saved, self.state, self.ranks
        self._print_settings()
        videos = self.folder / "videos"
        videos.mkdir(exist_ok=True)
        asked, memory = (None, None) if saved is None else (to_arrays(saved.requests), to_arrays(saved.memory))
        self.collect = collect = Collect(config, self.replay, state, self.worker, videos, asked, memory, ranks)
        optimizers = [] if saved is None else saved.optimizers
        facts = agent_facts(config, self.description)
        save = SaveRun(self.folder, config, collect, state, self.saves, self.files, facts, optimizers, ranks)
        stop = Stop(config, state, self.signals, ranks)
        records = []
        if ranks.is_first:
            self.trackers = Trackers(config.run.logger, self.folder, config, read_facts(self.folder)["run_id"])
            records = [Record(self.folder / METRICS_FILE, state, collect, self.console, self.trackers)]
        own = [collect, self.curriculum, *records, Guard(self.folder, ranks), save, stop]
        trainer = make_trainer(self.device, [Restore(optimizers), *own])
        if ranks.lead(lambda: (copy := self.saves.find(RUN_FILE)) is None or read_config(copy) != config):
            save.save_run(trainer, self.learner)  # so that a run that ends before its next save can be resumed
            ranks.lead(lambda: dump_config(config, self.folder / RUN_FILE))
        try:
            if is_unfinished := not stop.is_spent(self.learner):
                self._fit(trainer)
            if is_unfinished or collect.has_requests():
                with contextlib.suppress(Stopped):
                    if not state.interrupted:
                        collect.complete()
                agree_on_signals(state, ranks)
                for record in records:
                    record.write_evaluations()
                save.keep_best(self.learner)
                save.save(trainer, self.learner)
            with contextlib.suppress(Stopped):
                if not state.interrupted:
                    return Result(self.folder, 0, self._finish(trainer, save, videos / "final.webm"))
            agree_on_signals(state, ranks)
        except (WorkerEnded, UserError) as error:
            save.save(trainer, self.learner)
            raise name_save(error, self.folder) from None
        command = f"{own_command('train')} --resume {self.folder}{repeat_flag(config.env)}"
        if config.env.domain == USER_DOMAIN:
            command = f'latentplan.training.resume("{self.folder}", make_env=...)'
        self.console.console.print(f"stopped; to resume: {command}", soft_wrap=True)
        return Result(self.folder, exit_code(state.interrupted), {})

    def _fit(self, trainer: lightning.Trainer) -> None:
        batches = ReplayBatches(self.replay, self.config, self.curriculum, self.learner)
        self.console.start(self.learner.updates)
        try:
            # SIGTERMException is that of a signal before `Stop` has begun; `signals` has the signal too.
            with contextlib.suppress(SIGTERMException), torch.random.fork_rng(devices=[]):
                trainer.fit(self.learner, datamodule=ReplayData(batches))
        finally:
            self.console.stop()

    def _finish(self, trainer: lightning.Trainer, save: SaveRun, film: Path) -> dict[str, float]:
        clocks = save.clocks(self.learner)
        episodes = self.config.evaluation.final_episodes
        self.console.console.print(f"final evaluation: {episodes} episodes each of planner and actor")
        returns, page = self.ranks.lead(lambda: self._evaluate_last(film))
        summary = {mode: float(np.mean(values)) for mode, values in returns.items()}
        info = clocks | {"final_evaluation": returns}
        self.ranks.lead(lambda: write_whole(self.folder / FINAL_FILE, json.dumps(info | summary, indent=1)))
        save.save_agent("last", self.learner.averaged, info)
        done = f"{clocks['env_frames']:,} frames" if clocks["env_frames"] else f"{clocks['updates']:,} updates"
        self.console.console.print(
            f"trained {done} in {clocks['minutes']:.1f} min: planner "
            f"{summary['planner']:.1f}, actor {summary['actor']:.1f} ({episodes} episodes)"
        )
        best = self.state.best_return
        if summary["planner"] < best:
            best = self.ranks.lead(self._evaluate_best)
        if summary["planner"] >= best:
            save.save_agent("best", self.learner.averaged, info)
        self.state.best_return = max(best, summary["planner"])
        self.state.set_minutes(clocks["minutes"])
        save.save_run(trainer, self.learner)
        if self.trackers is not None:
            self.trackers.log_film(film, step=clocks["env_frames"] or clocks["updates"])
        if page is not None and self.ranks.is_first:
            report = write_report(self.config, self.folder, self.description.renderer, returns, page, film)
            if report is not None:
                self.console.console.print(f"report: {report}", soft_wrap=True)
        self.console.console.print(f"run folder: {self.folder}")
        return summary

    def _evaluate_last(self, film: Path) -> tuple[dict[str, list[float]], dict[str, Any] | None]:
        """Returns of the last agent, and what is recorded for the report, or None."""
        settings = self.config.evaluation
        film.unlink(missing_ok=True)  # of a run that was finished before and goes on
        returns = self._evaluate(self.learner.averaged, film if settings.video else None, record=settings.report)
        return returns, self._take_recording() if settings.report else None

    def _take_recording(self) -> dict[str, Any] | None:
        """What the worker recorded in the final evaluation; None if its process has ended."""
        try:
            self.worker.submit("take_recording")
            taken: dict[str, Any] = self.worker.result()
            return taken
        except WorkerEnded as error:
            self.collect.replace_worker(error)
            return None

    def _evaluate(
        self, model: WorldModel, film: Path | None = None, actor: bool = True, record: bool = False
    ) -> dict[str, list[float]]:
        episodes = self.config.evaluation.final_episodes
        returns: dict[str, list[float]] | None = None
        while returns is None:
            self.worker.submit("evaluate", episodes, film, copy_weights(model), actor, record)
            try:
                returns = self.worker.result()
            except WorkerEnded as error:
                self.collect.replace_worker(error)
        if self.state.received:
            raise Stopped
        return returns

    def _evaluate_best(self) -> float:
        """Mean return of the saved best agent's planner on the final starts; -inf if no best agent can be read.

        The highest mean of many short evaluations is partly chance, so the final starts decide between best and last.
        """
        folder = self.folder / CHECKPOINTS / "best"
        if not is_checkpoint(folder, (INFO,)):
            return float("-inf")
        try:
            model, _, info = load_model(folder, str(self.device))
        except UserError as error:
            self.console.console.print(f"warning: the best agent so far cannot be read: {error}", soft_wrap=True)
            return float("-inf")
        self.console.console.print(
            f"evaluating the best agent so far, of {info['updates']:,} updates, on the same starts"
        )
        mean = float(np.mean(self._evaluate(model, actor=False)["planner"]))
        self.console.console.print(f"its planner earned {mean:.1f}; checkpoints/best is the better of the two")
        return mean

    def _print_settings(self) -> None:
        lines = describe_run(
            self.config, self.folder, self.description, self.replay, self.learner, self.curriculum.note, self.ranks.size
        )
        for name, line in lines.items():
            self.console.console.print(f"{name:<12}{line}", soft_wrap=True)
