"""What a run says of itself: the lines at its start, the facts in its agents, and its report."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from latentplan import __version__
from latentplan.config import CollectionConfig, Config, EnvConfig, UserError
from latentplan.config.run_results import read_evaluations, read_facts
from latentplan.config.writing import write_whole
from latentplan.envs.registry import USERS_RENDERER
from latentplan.evaluation.statistics import confidence_interval
from latentplan.replay.buffer import Replay
from latentplan.reporting.report import ReportData, Returns, render_report
from latentplan.training.ranks import Ranks

if TYPE_CHECKING:
    from latentplan.training.collection.collector import Description
    from latentplan.training.learner.module import Learner

REPORT_FILE = "report.html"
FOLDER_TRIES = 20  # one a second, for a file system that shows new files late


def describe_run(
    config: Config, folder: Path, description: Description, replay: Replay, learner: Learner, note: str, num_ranks: int
) -> dict[str, str]:
    """The lines that a run prints at its start, by name.

    Args:
        config: Settings of the run.
        folder: Folder of the run.
        description: Facts of the environment.
        replay: The replay, of this process.
        learner: The learner.
        note: Text about the curriculum, for the line of the task.
        num_ranks: Processes that learn together.
    """
    run, env = config.run, config.env
    parameters = sum(parameter.numel() for parameter in learner.model.parameters())
    budget = [f"{run.frames:,} frames"] if run.frames else []
    budget += [f"{run.minutes:g} minutes"] if run.minutes else []
    budget += [f"{run.updates:,} updates"] if run.updates else []
    rows, recorded = int(replay.sizes.sum()), replay.num_recorded
    recorded_note = f", {recorded:,} of them recorded" if recorded else ""
    shares = f"{num_ranks} share each batch of {config.learning.batch_size} ({run.strategy}); the lines are of one"
    return {
        "task": f"{env.domain}-{env.task}, action repeat {env.action_repeat}{note}",
        **({} if env.objective is None else {"objective": env.objective}),
        **({} if num_ranks == 1 else {"processes": shares}),
        **_describe_workers(config.collection),
        "device": f"{learner.model.device}, {torch.get_num_threads()} threads",
        "renderer": _describe_renderer(env, description),
        "parameters": f"{parameters:,}; discount {description.discount:g}",
        "replay": f"{replay.num_bytes / 2**20:,.0f} MiB for {rows:,} frames{recorded_note}",
        "budget": " or ".join(budget),
        "run folder": str(folder),
    }


def _describe_renderer(env: EnvConfig, description: Description) -> str:
    """The line about the renderer; pictures that another than dm_control draws have no quality to choose."""
    facts = [value if name == "renderer" else f"{name} {value}" for name, value in description.renderer.items()]
    quality = f", quality {env.render_quality}" if description.renderer != USERS_RENDERER else ""
    return f"{', '.join(facts)}; {description.render_ms:.1f} ms per frame{quality}"


def _describe_workers(collection: CollectionConfig) -> dict[str, str]:
    """The line about several collection processes; none about one."""
    if collection.workers == 1 and collection.backend == "process":
        return {}
    place = "a Ray cluster" if collection.backend == "ray" else "this machine"
    note = ", asynchronous: the results depend on their speed" if collection.asynchronous else ""
    return {"workers": f"{collection.workers} on {place}{note}"}


def describe_change(before: int, now: int) -> str:
    """The line that a run prints when it resumes with another number of processes."""
    return (
        f"{'processes':<12}{now} in place of {before}: the rows of all replays are dealt anew, and the episodes that "
        "were running begin again"
    )


def agent_facts(config: Config, description: Description) -> dict[str, Any]:
    """Facts of a run that are saved with every agent."""
    return {
        "format": 1,
        "version": __version__,
        "domain": config.env.domain,
        "task": config.env.task,
        "discount": description.discount,
        "renderer": description.renderer,
    }


def write_report(
    config: Config,
    folder: Path,
    renderer: Mapping[str, str],
    returns: Mapping[str, list[float]],
    page: Mapping[str, Any],
    film: Path,
) -> Path | None:
    """Writes the page of a run; an error becomes a warning, because the run itself is complete.

    Args:
        config: Settings of the run.
        folder: Folder of the run.
        renderer: Name and settings of the renderer.
        returns: Returns of the final evaluation, by mode.
        page: What `Collector.take_recording` returned.
        film: The film of the final evaluation; it need not exist.

    Returns:
        Path of the page; None if there is none.
    """
    env = config.env
    deadlines = {"deadline of the search": config.planner.deadline_ms, "period of control": page["period_ms"]}
    data = ReportData(
        task=f"{env.domain}-{env.task}",
        config=config,
        returns=[Returns(mode, values, confidence_interval(values)) for mode, values in returns.items()],
        film=film if film.exists() else None,
        recording=page["recording"],
        decision_ms=page["decision_ms"],
        deadlines_ms={name: value for name, value in deadlines.items() if value is not None},
        facts={"run folder": str(folder), **read_facts(folder), "renderer": renderer},
    )
    try:
        data = replace(data, evaluations=read_evaluations(folder))
        return write_whole(folder / REPORT_FILE, render_report(data))
    except Exception as error:
        warnings.warn(f"no report of the run: {error}", RuntimeWarning, stacklevel=2)
        return None


def meet_ranks(ranks: Ranks, folder: Path, run_id: str = "") -> None:
    """Waits until rank 0 has made the folder of the run, and checks that all ranks see the same folder.

    Args:
        ranks: The processes that learn together.
        folder: The folder.
        run_id: Identifies the run in its folder; only rank 0 must know it.

    Raises:
        UserError: A rank sees another folder, such as one on a disk of its own machine.
    """
    if ranks.size == 1:
        return
    noted = ranks.lead(lambda: run_id)

    def check() -> None:
        for _ in range(FOLDER_TRIES):
            if read_facts(folder).get("run_id") == noted:
                return
            time.sleep(1.0)
        raise UserError(
            f"process {ranks.rank} does not see the folder {folder.absolute()} of process 0: several machines need a "
            "--run-dir that they share"
        )

    ranks.together(check)
