"""`latentplan sweep --space FILE.yaml --trials N`: search for better settings with many short runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from latentplan.commands.flags import overrides
from latentplan.commands.train import SHORT_FLAGS
from latentplan.config import Config, UserError
from latentplan.config.checks import at_least
from latentplan.config.env_id import import_named, lay_env
from latentplan.config.files import Preset, read_layer, to_yaml
from latentplan.config.parsing import option

MAX_TRIALS = 10_000
BEST_FILE = "best.yaml"


@dataclass(frozen=True, kw_only=True)
class Request:
    """The command line of a sweep.

    Attributes:
        space: YAML file of the settings that the trials vary, each with a list of values, or with `low`, `high` and,
            for a logarithmic scale, `log: true`.
        trials: Number of trials.
        jobs: Trials side by side. As many as there are cores get one thread each.
        out: Folder of the sweep; the same command goes on with a sweep that was stopped.
        ray_address: Ray cluster on whose machines the trials run, as HOST:PORT; None starts Ray on this machine.
        env_id: Environment of gymnasium's registry, as ID or module:ID, in place of a domain and a task.
        preset: Machine class; `auto` takes `gpu` where CUDA is usable.
        config: YAML file of settings of all trials, laid over the preset.
        settings: Settings of all trials, by section and name.
    """

    NOTES = "--frames is the budget of a trial; trials that fall behind are stopped before (ASHA)."

    space: Path = option(metavar="FILE")
    trials: int = 20
    jobs: int = 1
    out: Path = option(Path("runs/sweep"), metavar="DIR")
    ray_address: str | None = option(None, metavar="HOST:PORT")
    settings: dict[str, Any] = overrides(Config, SHORT_FLAGS)
    env_id: str | None = option(None, metavar="[MODULE:]ID")
    preset: Preset = "auto"
    config: Path | None = option(None, metavar="FILE")

    def __post_init__(self) -> None:
        at_least(self, trials=1, jobs=1)
        if self.trials > MAX_TRIALS:
            raise UserError(f"--trials must be at most {MAX_TRIALS:,}, got {self.trials}")
        lay_env(self.settings.get("env", {}), self.env_id)
        if "run_dir" in self.settings.get("run", {}):
            raise UserError("--run-dir is the folder of one run: give --out, the folder of the sweep")
        if self.settings.get("collection", {}).get("keep_episodes") is not None:
            raise UserError("--collection.keep_episodes is the folder of one run, and a sweep has several")


def run(request: Request) -> int:
    """Run the sweep, print its trials and the best settings, and return the exit code.

    Raises:
        UserError: The space or a setting is wrong, Ray is missing, or the folder holds another sweep.
    """
    from latentplan.config.estimates import choose_threads
    from latentplan.config.extras import require_extra
    from latentplan.training.checks import check_settings
    from latentplan.training.sweep.space import check_space, read_space

    space = read_space(request.space)
    given = {**request.settings}
    if request.env_id is not None:
        given["env"] = lay_env(given.get("env", {}), request.env_id)
        import_named(request.env_id)
    for key in space:
        section, _, name = key.partition(".")
        if name in given.get(section, {}):
            raise UserError(f"--{key} is a setting that {request.space} varies: leave out the flag")
    if "threads" not in given.get("run", {}):  # trials share the cores of their machine, which for Ray have one each
        threads = 1 if request.ray_address else choose_threads(1, request.jobs)
        given["run"] = {**given.get("run", {}), "threads": threads}
    from latentplan.training.sweep.trials import Sweep, best_of, run_sweep

    file = read_layer(request.config) if request.config else {}
    sweep = Sweep(
        request.out,
        space,
        request.trials,
        request.jobs,
        file,
        given,
        request.preset,
        request.env_id,
        request.ray_address,
    )
    shared = sweep.resolve(check_space(space, lambda values: check_settings(sweep.resolve(values)))).run
    if shared.frames is None:
        raise UserError("a sweep needs --frames, the budget of a trial")
    require_extra("latentplan sweep", "ray", "optuna")
    trials, number = run_sweep(sweep, shared)
    print()
    _print_table(trials, list(space))
    if number:
        print("stopped; the same command goes on with the sweep")
        return 128 + number
    best = best_of(trials)
    if best is None:
        return 1
    path = request.out / BEST_FILE
    from latentplan.config.writing import write_whole
    from latentplan.training.sweep.space import as_layer

    write_whole(path, text := to_yaml(as_layer(best.values)))
    print(f"\nbest settings (trial {best.number}), also in {path}, a file for --config:\n{text}", end="")
    return 0


def _print_table(trials: list[Any], names: list[str]) -> None:
    """Print one line for each trial: its state, its latest evaluation and its values."""
    from latentplan.reporting.runs import format_table

    rows = [["trial", "state", "frames", "planner", "actor", *names]]
    for trial in trials:
        last = trial.last
        measured = (
            ["", "", ""] if last is None else [f"{last.env_frames:,}", f"{last.planner:.1f}", f"{last.actor:.1f}"]
        )
        values = [f"{value:.4g}" if isinstance(value, float) else str(value) for value in map(trial.values.get, names)]
        rows.append([str(trial.number), trial.state, *measured, *values])
    print(format_table(rows, right=(0, 2, 3, 4)))
