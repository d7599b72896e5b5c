"""Goal conditioning: makes an agent that also pursues goals, from the folder and the replay of a trained agent."""

from __future__ import annotations

import contextlib
import json
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from latentplan.agents.checkpoint import load_model, read_info, resolve_checkpoint, save_checkpoint
from latentplan.config import USER_DOMAIN, Config, GoalsConfig, UserError, derive_seed, to_dict
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay, read_saved
from latentplan.training.collection.collector import Collector
from latentplan.training.console import StatusLine
from latentplan.training.goal_conditioning.learner import BoxSource, GoalLearner
from latentplan.training.run import Result
from latentplan.training.state import GOALS_FILE, INTERRUPTED, lock_folder, refuse_used, save_atomically

ROUND_DECISIONS = 125
SAVE_SECONDS = 300.0
PLAYED_FILE = "played.json"  # names the agent that played the replay in the same folder, and its settings


def learn_goals(
    checkpoint: Path | str, folder: Path | str, settings: GoalsConfig | None = None, *, device: str = "cpu"
) -> Result:
    """Teaches a trained agent to pursue goals that are named after training.

    Args:
        checkpoint: Folder of a run or of an agent. Rollouts start from beliefs in the replay of the run; an agent that
            has no replay plays first.
        folder: Folder for the new agent and the saved state.
        settings: Settings of the learning; None takes the defaults.
        device: "cpu" or "cuda".

    Returns:
        The folder, and a running mean of the updates' `worth`; see `GoalLearner.update`.

    Raises:
        UserError: The agent, its replay or the folder cannot be used.
    """
    folder = Path(folder)
    refuse_used(folder, GOALS_FILE, "--out")
    with lock_folder(folder):
        return _learn(Path(checkpoint), folder, settings or GoalsConfig(), device, None)


def resume_goals(
    folder: Path | str, *, updates: int | None = None, minutes: float | None = None, device: str = "cpu"
) -> Result:
    """Continues `learn_goals` from its last save.

    Args:
        folder: Folder that was given to `learn_goals`.
        updates: New total number of updates; None keeps the old number.
        minutes: New total budget of minutes; None keeps the old budget.
        device: "cpu" or "cuda".

    Raises:
        UserError: The folder holds nothing to resume, or the agent that the learning started from has changed.
    """
    path = Path(folder) / GOALS_FILE
    if not path.exists():
        raise UserError(f"nothing to resume in {folder}: {path} is missing")
    with lock_folder(Path(folder)):
        saved = read_saved(path, keys=("run", "source", "sha256", "settings", "minutes", "learner"))
        if read_info(saved["source"])["sha256"] != saved["sha256"]:
            raise UserError(f"{saved['source']} is not the agent from which {folder} started")
        settings = GoalsConfig(**saved["settings"])
        settings = replace(settings, updates=updates or settings.updates, minutes=minutes or settings.minutes)
        return _learn(Path(saved["run"]), Path(folder), settings, device, saved)


def load_replay(path: Path, model: WorldModel) -> Replay:
    """Loads the whole replay in a folder into main memory.

    Raises:
        UserError: The replay is damaged, or does not fit the model.
    """
    num_lanes, lane_size = read_saved(path / "rows.pt", keys=("episode",))["episode"].shape
    sizes = (model.action_dim, model.config.deter_dim, num_lanes, torch.device("cpu"), len(model.labels))
    replay = Replay(num_lanes * lane_size, *sizes)
    replay.load(path)
    return replay


def _load_or_play(
    agent: Path, sha256: str, folder: Path, model: WorldModel, config: Config, settings: GoalsConfig, line: StatusLine
) -> Replay:
    """Loads the replay of the agent's run if there is one, else a replay that the agent plays and the folder keeps."""
    collected, played, note = agent / "resume" / "replay", folder / "replay", folder / "replay" / PLAYED_FILE
    if (collected / "rows.pt").exists():
        return load_replay(collected, model)
    origin = {"sha256": sha256, "seed": settings.seed, "play_decisions": settings.play_decisions}
    if (folder / GOALS_FILE).exists() or (note.exists() and note.read_text() == json.dumps(origin)):
        line.print(f"using the replay that was played before, in {played}")
        return load_replay(played, model)
    if config.env.domain == USER_DOMAIN:
        raise UserError(f"{agent} has no replay, and its environment is your own: give the folder of its run")
    if (played / "rows.pt").exists() and not note.exists():
        raise UserError(f"{played} holds a replay of another agent: choose another --out")
    line.print(f"no replay in {agent}: playing {settings.play_decisions:,} decisions first")

    def report(done: int) -> None:
        line.update(f"played {done:,} of {settings.play_decisions:,} decisions")

    replay = play(config, model, settings.play_decisions, settings.seed, report)
    note.unlink(missing_ok=True)
    replay.save(played)
    note.write_text(json.dumps(origin))
    return replay


def _learn(run: Path, folder: Path, settings: GoalsConfig, device: str, saved: dict[str, Any] | None) -> Result:
    """Loads the agent and its replay, and learns until the budget is spent or a signal arrives.

    Args:
        run: Folder of the run or agent.
        folder: Folder for the new agent and the saved state.
        settings: Settings of the learning.
        device: "cpu" or "cuda".
        saved: State from which the learning is resumed; None starts from the first update.
    """
    source = resolve_checkpoint(run)
    model, config, info = load_model(source, device)
    if not model.goal_names:
        raise UserError(f"the agent of {run} was trained without named quantities, so there are no goals to learn")
    model.requires_grad_(False)
    line = StatusLine()
    try:
        replay = _load_or_play(run, info["sha256"], folder, model, config, settings, line)
    except KeyboardInterrupt:
        line.print("stopped while playing, before the first update: nothing is saved")
        return Result(folder, INTERRUPTED, {})
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(settings.seed, "heads"))
        model.add_goal_heads(settings.hidden_dim)
    frames_per_step = config.env.action_repeat
    learner = GoalLearner(model, settings, config.learning, info["discount"], frames_per_step, replay)
    earlier = 0.0
    if saved is not None:
        learner.load_state_dict(saved["learner"])
        earlier = saved["minutes"]
    started = last_save = time.monotonic()
    worth = math.nan

    def minutes() -> float:
        return earlier + (time.monotonic() - started) / 60.0

    def save() -> None:
        facts = {"updates": learner.updates, "minutes": round(minutes(), 1), "settings": to_dict(settings)}
        save_checkpoint(folder, model, config, info | {"goals": facts | {"from_sha256": info["sha256"]}})
        about = {"run": str(run.resolve()), "source": str(source.resolve()), "sha256": info["sha256"]}
        state = {"settings": to_dict(settings), "minutes": minutes(), "learner": learner.state_dict()}
        save_atomically(about | state, folder / GOALS_FILE)

    with line, _stop_on_signals() as should_stop:
        while learner.updates < settings.updates and not (should_stop() or minutes() >= (settings.minutes or math.inf)):
            parts = learner.update()
            worth = parts["worth"] if math.isnan(worth) else 0.99 * worth + 0.01 * parts["worth"]
            line.update(
                f"update {learner.updates:,} of {settings.updates:,} | imagined worth {worth:.3f} of 1 | "
                f"entropy {parts['entropy']:.2f} nats | {minutes():.1f} min"
            )
            if time.monotonic() - last_save > SAVE_SECONDS:
                save()
                last_save = time.monotonic()
        save()
        if should_stop():
            line.print(f"stopped; to resume: python scripts/goals.py --resume {folder}")
            return Result(folder, INTERRUPTED, {})
        line.print(f"agent: {folder}")
    return Result(folder, 0, {"worth": worth})


@contextlib.contextmanager
def _stop_on_signals() -> Iterator[Callable[[], bool]]:
    """Turns the first SIGINT or SIGTERM into a flag, so that the running update is finished; a second one interrupts.

    Yields:
        A function that tells whether a signal has arrived.
    """
    received: list[int] = []

    def receive(number: int, frame: Any) -> None:
        if received:
            raise KeyboardInterrupt
        received.append(number)

    previous = {number: signal.signal(number, receive) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def play(config: Config, model: WorldModel, decisions: int, seed: int, report: Callable[[int], None]) -> Replay:
    """Plays with an agent: the actor explores for the agent's task in one round, the planner pursues a box in the next.

    Args:
        config: Settings of the agent, with its exploration noise.
        model: World model of the agent, which predicts quantities.
        decisions: Decisions to play, rounded up to whole rounds of 125.
        seed: Seed of every random stream.
        report: Called after each round with the number of decisions so far.

    Returns:
        A replay with one row per decision, and one more per episode.
    """
    single = replace(config, env=replace(config.env, num_envs=1), run=replace(config.run, seed=seed))
    size = 2 * (decisions + ROUND_DECISIONS)  # an episode has one row more than decisions
    replay = Replay(size, model.action_dim, model.config.deter_dim, 1, torch.device("cpu"), len(model.labels))
    collector = Collector(single, None, "cpu")
    heads = [name for name in model.state_dict() if name.startswith("goal_heads.")]
    weights = {name: value.cpu().numpy() for name, value in model.state_dict().items() if name not in heads}
    generator = torch.Generator().manual_seed(derive_seed(seed, "play"))
    try:
        for counter in range(-(-decisions // ROUND_DECISIONS)):
            goal = _draw_goal(model, replay, generator) if counter % 2 else None
            behaviour = "actor" if goal is None else "planner"
            collected = collector.collect(weights, behaviour, ROUND_DECISIONS, counter, goal=goal)
            replay.add(0, collected.rows[0])
            report((counter + 1) * ROUND_DECISIONS)
    finally:
        collector.close()
    return replay


def describe_box(names: Sequence[str], low: Sequence[float], high: Sequence[float]) -> str:
    """The objective expression of a box, such as `speed > 1.0 and speed < 2.0`, from the ends of its intervals."""
    clauses = []
    for name, least, most in zip(names, low, high, strict=True):
        if least == most:
            clauses.append(f"{name} -> {least:.6f}")
            continue
        clauses += [f"{name} > {least:.6f}"] if math.isfinite(least) else []
        clauses += [f"{name} < {most:.6f}"] if math.isfinite(most) else []
    return " and ".join(clauses)


def _draw_goal(model: WorldModel, replay: Replay, generator: torch.Generator) -> str:
    """An expression for a random box around the quantities observed so far."""
    rows = np.flatnonzero(replay.episode.reshape(-1) >= 0)
    observed = replay.labels[torch.from_numpy(rows)][:, : len(model.goal_names)]
    low, high, _ = BoxSource(observed, model.goal_scales.cpu(), generator).draw(1, generator)
    return describe_box(model.goal_names, low[0].tolist(), high[0].tolist())
