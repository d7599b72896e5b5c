"""The trials of a sweep: runs in processes of their own, which Ray Tune starts, watches and stops."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from latentplan.config import Config, RunConfig, UserError, make_folder
from latentplan.config.extras import MissingExtra, import_extra
from latentplan.config.files import Layer, compose, dump_config
from latentplan.config.run_folder import run_saves
from latentplan.config.run_results import Evaluation, find_state, is_locked, note_state, read_evaluations
from latentplan.config.writing import write_whole
from latentplan.training.child_run import LOG, ChildRun, last_line
from latentplan.training.cluster import join_cluster
from latentplan.training.signals import Signals
from latentplan.training.sweep.space import Range, Space, as_layer

PART = "latentplan sweep"
SHARED = ("frames", "minutes", "updates", "seed")  # settings of the run that decide what a trial earns
TUNE_FOLDER, SETTINGS_FOLDER, SWEEP_FILE, TRIAL_FILE = "tune", "settings", "sweep.json", "trial.json"
POLL_S = 0.5
SAVING_S = 60.0  # for a run that was asked to stop
LEAST_SHARE = 1 / 9  # of the frames, before which no trial is stopped
REDUCTION = 3  # one of so many trials goes on at each rung
RETRIES = 2  # of a trial whose process or machine ended


@dataclass(frozen=True)
class Sweep:
    """What all trials of a sweep share.

    Attributes:
        folder: Folder of the sweep; every machine of the cluster sees it.
        space: The settings that trials vary.
        trials: Number of trials.
        jobs: Trials side by side.
        file: Settings of the file of all trials.
        given: Settings of the flags of all trials.
        preset: Machine class.
        env_id: Environment of gymnasium's registry as MODULE:ID, or None.
        address: Address of the Ray cluster, or None.
        program: Words after the interpreter that call `latentplan train`.
    """

    folder: Path
    space: Space
    trials: int
    jobs: int
    file: Layer
    given: Layer
    preset: str
    env_id: str | None
    address: str | None
    program: tuple[str, ...] = ("-m", "latentplan", "train")

    def resolve(self, values: Layer) -> Config:
        """The settings of a trial with these values.

        Raises:
            UserError: A value is not allowed.
        """
        names = {*self.given, *values}
        return compose(
            self.file, {name: {**self.given.get(name, {}), **values.get(name, {})} for name in names}, self.preset
        )


class Trial(NamedTuple):
    """One trial.

    Attributes:
        number: Its number, from 1.
        values: Its values, by the name of the setting.
        state: State of its run: `finished`, `stopped` (early, or with the sweep), `failed` or `running`.
        last: Its latest evaluation; None before the first.
    """

    number: int
    values: dict[str, Any]
    state: str
    last: Evaluation | None


def run_sweep(sweep: Sweep, shared: RunConfig) -> tuple[list[Trial], int]:
    """Runs the trials of a sweep that have not ended; a sweep that was stopped goes on.

    Args:
        sweep: The sweep.
        shared: Frames, device and seed, which all trials share.

    Returns:
        The trials that have begun, and the number of the signal that stopped the sweep or 0.

    Raises:
        UserError: Ray is not installed or not reached, or the folder holds a sweep with other settings.
    """
    os.environ |= {
        "TUNE_DISABLE_SIGINT_HANDLER": "1",
        "TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1",
        "RAY_AIR_NEW_OUTPUT": "0",
    }
    try:
        tune = import_extra("ray.tune", PART)
    except ImportError as error:  # of Ray without its part `tune`
        raise MissingExtra(f"{PART} needs ray[tune]; run: pip install 'latentplan[ray]'") from error
    _note(sweep, shared)
    ray = join_cluster(sweep.address, sweep.jobs, log_to_driver=False)
    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)  # `Lines` says what happens
    import_extra("optuna", PART).logging.set_verbosity(logging.ERROR)
    warnings.filterwarnings("ignore", module="optuna")
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # until Tune takes it as the request to stop
    with Signals(lambda _: os.kill(os.getpid(), signal.SIGUSR1)) as signals:
        results = _make_tuner(tune, sweep, shared).fit()
    ray.shutdown()
    _await_saves(sweep.folder)
    if any(result.error for result in results) and not signals.received:
        print(
            "trials that failed: "
            + str(sum(bool(result.error) for result in results))
            + "; the same command tries them again"
        )
    return list_trials(sweep.folder), signals.received


def _await_saves(folder: Path) -> None:
    """Waits for runs that were stopped and still save themselves."""
    deadline = time.monotonic() + SAVING_S
    while time.monotonic() < deadline and any(is_locked(path.parent) for path in folder.glob(f"*/{TRIAL_FILE}")):
        time.sleep(POLL_S)


def list_trials(folder: Path) -> list[Trial]:
    """The trials of a sweep that have begun, by number."""
    found = []
    for path in folder.glob(f"*/{TRIAL_FILE}"):
        number, values = json.loads(path.read_text())
        evaluations = _evaluations(path.parent)
        found.append(Trial(number, values, find_state(path.parent)[0], evaluations[-1] if evaluations else None))
    return sorted(found, key=lambda trial: trial.number)


def best_of(trials: list[Trial]) -> Trial | None:
    """The trial with the highest return of the planner, of those that ended with their budget where there are any."""
    measured = [(trial.last.planner, trial) for trial in trials if trial.last is not None]
    finished = [(score, trial) for score, trial in measured if trial.state == "finished"] or measured
    return max(finished, key=lambda pair: pair[0])[1] if finished else None


def _make_tuner(tune: Any, sweep: Sweep, shared: RunConfig) -> Any:
    """The tuner of a new sweep, or of one that was begun."""
    resources = {"cpu": 1, "gpu": int(shared.device == "cuda")}
    trainable = tune.with_resources(tune.with_parameters(run_trial, sweep=sweep), resources)
    path = str((sweep.folder / TUNE_FOLDER).absolute())
    if tune.Tuner.can_restore(path):
        return tune.Tuner.restore(path, trainable, resume_unfinished=True, resume_errored=True)
    frames = int(shared.frames or 0)
    search = import_extra("ray.tune.search.optuna", PART).OptunaSearch(seed=shared.seed)
    scheduler = import_extra("ray.tune.schedulers", PART).ASHAScheduler(
        time_attr="spent",
        max_t=frames,
        grace_period=max(1, int(LEAST_SHARE * frames)),
        reduction_factor=REDUCTION,
    )
    return tune.Tuner(
        trainable,
        param_space={name: _draw(tune, values) for name, values in sweep.space.items()},
        tune_config=tune.TuneConfig(
            metric="planner",
            mode="max",
            search_alg=search,
            scheduler=scheduler,
            num_samples=sweep.trials,
            max_concurrent_trials=sweep.jobs,
        ),
        run_config=tune.RunConfig(
            name=TUNE_FOLDER,
            storage_path=str(sweep.folder.absolute()),
            failure_config=tune.FailureConfig(max_failures=RETRIES),
            callbacks=[_make_lines(sweep.folder)],
            verbose=0,
        ),
    )


def _draw(tune: Any, values: Range | tuple[Any, ...]) -> Any:
    """The distribution of Tune for the values of a setting."""
    if not isinstance(values, Range):
        return tune.choice(list(values))
    if values.is_whole:
        ends = int(values.low), int(values.high) + 1
        return (tune.lograndint if values.is_log else tune.randint)(*ends)
    return (tune.loguniform if values.is_log else tune.uniform)(values.low, values.high)


def _make_lines(folder: Path) -> Any:
    """Prints a line for every evaluation of a trial, and for every trial that failed."""

    class Lines(import_extra("ray.tune", PART).Callback):  # type: ignore[misc]
        def on_trial_result(self, iteration: int, trials: list[Any], trial: Any, result: Any, **_: Any) -> None:
            frames, planner = result["env_frames"], result["planner"]
            self.say(trial, f"{frames:>9,} frames  planner {planner:6.1f}")

        def on_trial_error(self, iteration: int, trials: list[Any], trial: Any, **_: Any) -> None:
            self.say(trial, "failed: " + last_line(folder / trial.trial_id))

        def say(self, trial: Any, text: str) -> None:
            print(f"trial {trial.experiment_tag.partition('_')[0]:>3}  {text}", flush=True)

    return Lines()


def run_trial(values: dict[str, Any], sweep: Sweep) -> None:
    """Runs one trial until its end, and reports each of its evaluations to Tune, which may stop it there."""
    tune = import_extra("ray.tune", PART)
    context = tune.get_context()
    name = context.get_trial_id()
    number = int(Path(context.get_trial_dir()).name.partition(f"{name}_")[2].partition("_")[0])
    folder, settings = sweep.folder / name, sweep.folder / SETTINGS_FOLDER / f"{name}.yaml"
    for path in (folder, settings.parent):
        make_folder(path)
    write_whole(folder / TRIAL_FILE, json.dumps([number, values]) + "\n")
    try:
        config = sweep.resolve(as_layer(values))
    except UserError as error:  # of values that are not allowed beside each other
        (folder / LOG).write_text(f"error: {error}\n")
        note_state(folder, "failed", reason=str(error))
        raise
    budget = int(config.run.frames or 0)
    dump_config(config, settings)
    reported = len(_evaluations(folder)) - 1  # a trial that goes on repeats its latest report
    with _training(sweep, folder, settings) as process:
        while True:
            code = process.poll() if process is not None else 0
            found = _evaluations(folder)
            for each in found[max(0, reported) :]:
                spent = min(each.env_frames, budget - 1)  # a trial with its whole budget ends by itself
                tune.report({"planner": each.planner, "env_frames": each.env_frames, "spent": spent})
            reported = max(reported, len(found))  # a file that cannot be read now hides those that were reported
            if code is not None:
                break
            time.sleep(POLL_S)
    if code:
        raise RuntimeError(f"exit code {code}: {last_line(folder)}")


@contextlib.contextmanager
def _training(sweep: Sweep, folder: Path, settings: Path) -> Iterator[ChildRun | None]:
    """The process of a run, which saves itself and ends with the context; None where the run has ended before."""
    while is_locked(folder):  # by a process of an earlier start that still saves itself
        time.sleep(POLL_S)
    if find_state(folder)[0] == "finished":
        yield None
        return
    words = ["--config", str(settings), "--run-dir", str(folder)]
    if run_saves(folder).exist():
        words = ["--resume", str(folder)]
    if sweep.env_id is not None:
        words += ["--env-id", sweep.env_id]
    process = ChildRun(folder, [sys.executable, *sweep.program, *words])
    try:
        yield process
    finally:
        if process.poll() is None:
            process.stop()
            process.wait(SAVING_S)


def _note(sweep: Sweep, shared: RunConfig) -> None:
    """Notes what the sweep is, or checks that the folder holds the same one."""
    make_folder(sweep.folder)
    facts: dict[str, Any] = {
        "trials": sweep.trials,
        "space": {
            key: list(values) if isinstance(values, tuple) else vars(values) for key, values in sweep.space.items()
        },
        "file": sweep.file,
        "given": {name: fields for name, fields in sweep.given.items() if name != "run"},
        "preset": sweep.preset,
        **{name: getattr(shared, name) for name in SHARED},
        "env_id": sweep.env_id,
    }
    facts = json.loads(json.dumps(facts, default=str))
    path = sweep.folder / SWEEP_FILE
    if not path.exists():
        write_whole(path, json.dumps(facts, indent=1) + "\n")
        return
    try:
        known = json.loads(path.read_text())
    except (OSError, ValueError):
        raise UserError(f"{path} cannot be read: choose another --out") from None
    for name, value in facts.items():
        if known.get(name, value) != value:  # an earlier version noted less
            raise UserError(f"{sweep.folder} holds a sweep with other settings ({name}): choose another --out")


def _evaluations(folder: Path) -> list[Evaluation]:
    """The evaluations so far; none while a file is being written."""
    try:
        return read_evaluations(folder)
    except UserError:
        return []
