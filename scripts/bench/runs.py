"""Training runs that a benchmark starts: their flags and their folders.

Every run is a `train.py` process with a folder of its own. A run that was begun there goes on from its last save, and a
run that is finished is not repeated.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.report import write_json
from latentplan.commands import train
from latentplan.commands.flags import overrides, read_request
from latentplan.config import Config, Device, UserError
from latentplan.config.checks import above_zero
from latentplan.config.env_id import FLAG, import_named, is_by_id
from latentplan.config.files import Preset, read_config
from latentplan.config.parsing import option
from latentplan.config.run_folder import RUN_FILE, read_run_config, run_saves
from latentplan.config.run_results import comparable_settings
from latentplan.config.suites import ID_DOMAIN
from latentplan.training.checks import check_settings

OWN_FLAGS = {  # settings that flags of these benchmarks set for each run
    "env.domain": "--tasks",
    "env.task": "--tasks",
    "run.seed": "--seeds",
    "run.frames": "--frames",
    "run.minutes": "--minutes",
    "run.run_dir": "--out",
}
SCRIPT = Path(__file__).resolve().parent.parent / "train.py"
FINISHED = "finished.json"


@dataclass(frozen=True, kw_only=True)
class RunsRequest:
    """Flags of a benchmark that trains over tasks and seeds.

    Attributes:
        tasks: Tasks, each as domain-task.
        seeds: Seeds of each task, each once.
        frames: Simulator frames of each run; without frames and minutes, a run has the budget of the preset.
        minutes: Minutes of each run; with frames given too, a run ends at the first of the two limits.
        out: Folder of the runs and results; finished runs in this folder are not repeated.
        preset: Machine class, as for training; None takes `gpu` where CUDA is usable, else `cpu`.
        device: Device, as for training; None takes CUDA where it is usable.
        config: YAML file of settings, as for training.
        settings: Settings of every run, by section and name.
    """

    tasks: tuple[str, ...] = option(("cartpole-swingup", "walker-walk"), separator=",")
    seeds: tuple[int, ...] = option((0, 1), separator=",")
    frames: int | None = None
    minutes: float | None = None
    out: Path = option(Path("runs/learn"), metavar="DIR")
    preset: Preset | None = None
    device: Device | None = None
    config: Path | None = option(None, metavar="FILE")
    settings: dict[str, Any] = overrides(Config)

    def __post_init__(self) -> None:
        above_zero(self, "frames", "minutes")
        object.__setattr__(self, "seeds", tuple(dict.fromkeys(self.seeds)))
        if min(self.seeds, default=0) < 0:
            raise UserError(f"--seeds must be at least 0, got {min(self.seeds)}")
        for key, own in OWN_FLAGS.items():
            section, _, name = key.partition(".")
            if name in self.settings.get(section, {}):
                raise UserError(f"{own} sets --{key} here; give {own}")

    @property
    def budget(self) -> tuple[str, ...]:
        """The flags of `train.py` that end a run."""
        updates = self.settings.get("run", {}).get("updates")
        given = (("--frames", self.frames), ("--minutes", self.minutes), ("--updates", updates))
        return tuple(word for name, value in given if value is not None for word in (name, f"{value:.15g}"))

    @property
    def forwarded(self) -> tuple[str, ...]:
        """The other flags of `train.py` that all runs share."""
        flags: dict[str, Any] = {"--preset": self.preset, "--device": self.device, "--config": self.config}
        words = [word for name, value in flags.items() if value is not None for word in (name, str(value))]
        for section, fields in self.settings.items():
            for name, value in fields.items():
                if (section, name) == ("run", "updates"):  # part of the budget
                    continue
                words += [f"--{section}.{name}", value if isinstance(value, str) else json.dumps(value)]
        return tuple(words)


@dataclass(frozen=True)
class TrainingRun:
    """One run of a task and a seed.

    Attributes:
        task: The task as domain-task, or as gymnasium-ID; a domain alone stands for its usual task.
        seed: Seed of the run.
        folder: Folder of the run.
        budget: Flags that end the run.
        extra: The other flags of a new run.
    """

    task: str
    seed: int
    folder: Path
    budget: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Task and seed, for messages."""
        return f"{self.task}, seed {self.seed}"

    @property
    def limits(self) -> dict[str, float]:
        """The budget as numbers, by flag."""
        return _read_limits(self.budget)

    def resolve(self) -> Config:
        """The settings of the run as a new one.

        Raises:
            UserError: A flag is wrong.
        """
        return train.resolve(read_request(train.Request, self._new_flags()))

    def check(self) -> Config:
        """The settings of the run, if it can be started or continued.

        Raises:
            UserError: A flag is wrong, the run was begun with other settings, or the machine cannot serve it.
        """
        config = self.resolve()
        check_same(config, self.folder)
        if not self.is_finished():
            if is_by_id(config.env):
                import_named(str(config.env.task))
            check_settings(config)
        return config

    def command(self) -> list[str]:
        """The command line that begins the run, or continues it from its last save."""
        is_begun = run_saves(self.folder).exist()
        flags = self._new_flags()
        if is_begun:
            flags = ["--resume", str(self.folder), *self.budget, *(flags[:2] if flags[0] == FLAG else ())]
        return [sys.executable, str(SCRIPT), *flags]

    def is_finished(self) -> bool:
        """Whether the run has ended, with this budget or a larger one of the same kind."""
        try:
            spent = _read_limits(json.loads((self.folder / FINISHED).read_text())["budget"])
        except (OSError, ValueError, TypeError, KeyError):  # the marker is missing, or was written by something else
            return False
        return spent.keys() == self.limits.keys() and all(spent[name] >= limit for name, limit in self.limits.items())

    def mark_finished(self) -> None:
        """Note that the run has ended with its budget."""
        write_json(self.folder / FINISHED, {"budget": list(self.budget)})

    def _new_flags(self) -> list[str]:
        domain, _, name = self.task.partition("-")
        chosen = [FLAG, name] if domain == ID_DOMAIN else ["--domain", domain, *(["--task", name] if name else [])]
        return [*chosen, "--seed", str(self.seed), "--run-dir", str(self.folder), *self.budget, *self.extra]


def check_same(config: Config, folder: Path) -> None:
    """Checks that the run in a folder, if there is one, has these settings, except for the budget.

    Settings that cannot be read are left to the run, which then fails alone.

    Raises:
        UserError: A setting differs; the message names the first such setting.
    """
    begun = _read_begun(folder)
    if begun is None:
        return
    asked, known = (comparable_settings(each) for each in (config, begun))
    for name, value in asked.items():
        if known[name] != value:
            raise UserError(f"{folder} was begun with --{name} {known[name]}, not {value}: choose another --out")


def _read_begun(folder: Path) -> Config | None:
    try:
        if run_saves(folder).exist():
            return read_run_config(folder)[0]
        return read_config(folder / RUN_FILE) if (folder / RUN_FILE).exists() else None
    except UserError:
        return None


def _read_limits(budget: Sequence[str]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(budget[::2], budget[1::2], strict=True)}
