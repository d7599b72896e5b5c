"""Goal conditioning: makes an agent that also pursues goals, from the folder and the replay of a trained agent."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from latentplan.agents.checkpoint import load_model, read_info, resolve_checkpoint, save_checkpoint
from latentplan.config import USER_DOMAIN, Config, GoalsConfig, UserError, derive_seed, to_dict
from latentplan.config.commit import Save, Saves
from latentplan.config.run_folder import GOALS, RUN_FILE, SAVES_FOLDER, lock_folder, require_saves, run_saves
from latentplan.models import WorldModel
from latentplan.replay.buffer import Replay
from latentplan.replay.dealing import DealtRows, count_ranks
from latentplan.replay.disk import FORMAT as REPLAY_FORMAT
from latentplan.replay.disk import ReplayFiles, count_saved, save_replay
from latentplan.training.collection.collector import Collector
from latentplan.training.console import StatusLine, own_command
from latentplan.training.goal_conditioning.learner import BoxSource, GoalLearner, GoalLearnerState
from latentplan.training.run import Result
from latentplan.training.signals import Signals, exit_code, raise_interrupt
from latentplan.training.state import (
    build_settings,
    load_values,
    refuse_used,
    remove_leftovers,
    save_values,
    warn_of_loss,
)

ROUND_DECISIONS = 125
SAVE_SECONDS = 300.0
KIND, FORMAT = GOALS, 2
LoadedAgent = tuple[Path, WorldModel, Config, dict[str, Any]]
PLAYED_FOLDER = "replay"
SAVED = {
    "run": str,
    "source": str,
    "sha256": str,
    "settings": dict[str, Any],
    "minutes": float,
    "learner": GoalLearnerState,
}
"""The types of what a save holds."""


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
    refuse_used(folder, KIND, "--out")
    agent = _load_agent(Path(checkpoint), device)  # before the folder is made
    with lock_folder(folder):
        return _learn(Path(checkpoint), agent, folder, settings or GoalsConfig(), None)


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
    require_saves(Path(folder), KIND)
    with lock_folder(Path(folder)):
        saved, settings = read_resumed(folder, updates=updates, minutes=minutes)
        run = Path(saved["run"])
        return _learn(run, _load_agent(run, device), Path(folder), settings, saved)


def read_resumed(
    folder: Path | str, *, updates: int | None = None, minutes: float | None = None
) -> tuple[dict[str, Any], GoalsConfig]:
    """What goal-conditioned learning continues with: its last save and its settings.

    Args:
        folder: As for `resume_goals`, and so are the others.
        updates: New total number of updates.
        minutes: New total budget of minutes.

    Raises:
        UserError: The folder holds nothing to resume, or the agent that the learning started from has changed.
    """
    require_saves(Path(folder), KIND)
    saved = load_values(_saves(Path(folder)), SAVED)
    if read_info(saved["source"])["sha256"] != saved["sha256"]:
        raise UserError(f"{saved['source']} is not the agent from which {folder} started")
    settings = build_settings(GoalsConfig, saved["settings"], Path(folder))
    return saved, replace(settings, updates=updates or settings.updates, minutes=minutes or settings.minutes)


def load_replay(save: Save, model: WorldModel) -> Replay:
    """Loads the whole replay of a save into main memory, of all processes that have learned together.

    Raises:
        UserError: The replay does not fit the model.
    """
    dealt = DealtRows(save, 0, 1) if count_ranks(save) > 1 else None
    counts = count_saved(save) if dealt is None else dealt.counts
    replay = Replay(
        max(1, counts.num_lanes * counts.lane_rows),
        model.action_dim,
        model.config.deter_dim,
        counts.num_lanes,
        torch.device("cpu"),
        len(model.labels),
        model.spaces.frame_shape,
        counts.recorded_rows,
    )
    if dealt is None:
        ReplayFiles(save.folder.parent, replay).read(save)
    else:
        dealt.fill(replay)
    return replay


def _saves(folder: Path) -> Saves:
    return Saves(folder / SAVES_FOLDER, KIND, FORMAT)


def _load_or_play(
    agent: Path, sha256: str, folder: Path, model: WorldModel, config: Config, settings: GoalsConfig, line: StatusLine
) -> Replay:
    """Loads the replay of the agent's run if there is one, else a replay that the agent plays and the folder keeps."""
    if (agent / RUN_FILE).exists() and (agent / SAVES_FOLDER).exists():
        save, problems = run_saves(agent).newest()
        warn_of_loss(save, problems)
        replay = load_replay(save, model)
        if len(replay) == 0:
            raise UserError(f"{agent} has collected nothing that goals could be learned from: train it for longer")
        return replay
    origin = {"sha256": sha256, "seed": settings.seed, "play_decisions": settings.play_decisions}
    played = Saves(folder / PLAYED_FOLDER, "replay", REPLAY_FORMAT)
    if played.exist():
        save, _ = played.newest()
        if save.note == origin or _saves(folder).exist():
            line.print(f"using the replay that was played before, in {played.folder}")
            return load_replay(save, model)
        shutil.rmtree(played.folder)  # of another agent, and nothing was learned from it
    if config.env.domain == USER_DOMAIN:
        raise UserError(f"{agent} has no replay, and its environment is your own: give the folder of its run")
    line.print(f"no replay in {agent}: playing {settings.play_decisions:,} decisions first")

    def report(done: int) -> None:
        line.update(f"played {done:,} of {settings.play_decisions:,} decisions")

    replay = play(config, model, settings.play_decisions, settings.seed, report)
    save_replay(replay, played.folder, origin)
    return replay


def _learn(run: Path, agent: LoadedAgent, folder: Path, settings: GoalsConfig, saved: dict[str, Any] | None) -> Result:
    """Loads the replay of an agent, and learns until the budget is spent or a signal arrives.

    Args:
        run: Folder of the run or agent.
        agent: What `_load_agent` found there.
        folder: Folder for the new agent and the saved state.
        settings: Settings of the learning.
        saved: State from which the learning is resumed; None starts from the first update.
    """
    source, model, config, info = agent
    model.requires_grad_(False)
    line, signals = StatusLine(), Signals(raise_interrupt)
    try:
        with signals:
            replay = _load_or_play(run, info["sha256"], folder, model, config, settings, line)
    except KeyboardInterrupt:
        line.print("stopped while playing, before the first update: nothing is saved")
        return Result(folder, exit_code(signals.received), {})
    learner = _make_learner(model, config, info["discount"], replay, settings)
    saves, earlier = _saves(folder), 0.0
    if saved is not None:
        saves.newest()  # which the next save keeps
        earlier = _load(learner, saved, folder)
    started = last_save = time.monotonic()
    worth, signals = math.nan, Signals()

    def minutes() -> float:
        return earlier + (time.monotonic() - started) / 60.0

    def save() -> None:
        facts = {"updates": learner.updates, "minutes": round(minutes(), 1), "settings": to_dict(settings)}
        about = {"run": str(run.resolve()), "source": str(source.resolve()), "sha256": info["sha256"]}
        state = {"settings": to_dict(settings), "minutes": minutes(), "learner": learner.state_dict()}
        save_values(saves, about | state, {"updates": learner.updates, "minutes": round(minutes(), 1)})
        # Last, because a folder that holds an agent and no save could be neither resumed nor begun again.
        save_checkpoint(folder, model, config, info | {"goals": facts | {"from_sha256": info["sha256"]}})

    with line, signals:
        remove_leftovers(folder)
        budget = settings.minutes or math.inf
        while learner.updates < settings.updates and not (signals.received or minutes() >= budget):
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
        if signals.received:
            line.print(f"stopped; to resume: {own_command('goals')} --resume {folder}")
            return Result(folder, exit_code(signals.received), {})
        line.print(f"agent: {folder}")
    return Result(folder, 0, {"worth": worth})


def _load(learner: GoalLearner, saved: dict[str, Any], folder: Path) -> float:
    """Loads what was saved into a learner, and returns the minutes that were spent.

    Raises:
        UserError: The saved weights do not fit the agent, or the minutes are no number of minutes.
    """
    if not (math.isfinite(saved["minutes"]) and saved["minutes"] >= 0.0):
        raise UserError(f"the last save in {folder} is damaged: minutes is {saved['minutes']}")
    try:
        learner.load_state_dict(saved["learner"])
    except RuntimeError as error:
        reason = str(error).splitlines()[-1].strip()
        raise UserError(f"what is saved in {folder} does not fit its agent: {reason}") from None
    return float(saved["minutes"])


def _load_agent(run: Path, device: str) -> LoadedAgent:
    """The agent of a folder: its own folder, and what `load_model` returns.

    Raises:
        UserError: The agent cannot be loaded, or cannot learn goals.
    """
    source = resolve_checkpoint(run)
    model, config, info = load_model(source, device)
    if not model.goal_names:
        raise UserError(f"the agent of {run} was trained without named quantities, so there are no goals to learn")
    if model.has_choices:
        raise UserError(
            f"{run} has discrete actions, and goals are learned for continuous actions only: let the planner pursue "
            "them (--objective)"
        )
    if model.spaces.vector_dim:
        raise UserError(
            f"{run} was trained with env.vectors, and goals are learned from pictures alone, without env.vectors: let "
            "the planner pursue them (--objective)"
        )
    return source, model, config, info


def _make_learner(
    model: WorldModel, config: Config, discount: float, replay: Replay, settings: GoalsConfig
) -> GoalLearner:
    """Adds goal heads with new weights to a model, and makes their learner."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derive_seed(settings.seed, "heads"))
        model.add_goal_heads(settings.hidden_dim)
    return GoalLearner(model, settings, config.learning, discount, config.env.action_repeat, replay)


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
    single = replace(
        config,
        env=replace(config.env, num_envs=1),
        run=replace(config.run, seed=seed),
        collection=replace(config.collection, enabled=True, keep_episodes=None),
    )
    size = 2 * (decisions + ROUND_DECISIONS)  # an episode has one row more than decisions
    sizes = (model.action_dim, model.config.deter_dim, 1, torch.device("cpu"), len(model.labels))
    replay = Replay(size, *sizes, frame_shape=model.spaces.frame_shape)
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
    rows = np.flatnonzero(replay.episode >= 0)
    observed = replay.labels[torch.from_numpy(rows)][:, : len(model.goal_names)]
    low, high, _ = BoxSource(observed, model.goal_scales.cpu(), generator).draw(1, generator)
    return describe_box(model.goal_names, low[0].tolist(), high[0].tolist())
