"""Distillation: the actor learns to act as the planner does, in rounds (DAgger, Ross et al. 2011, section 3).

Only the actor changes; the world model and the value head stay as they are. A round has three stages:

1. collect: episodes are played, and the planner labels every belief with its first action;
2. train: the actor learns from all labels so far;
3. select: the actor is evaluated, and kept if it is the best so far.

The state is saved after each stage, and each stage draws from its own random streams. An interrupted distillation
therefore repeats at most one stage, and ends with the same agent as an uninterrupted one.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.base import ModelAgent
from latentplan.agents.checkpoint import load_model, resolve_checkpoint, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import USER_DOMAIN, DistillConfig, PlannerConfig, UserError, derive_seed, to_dict
from latentplan.config.env_id import choose_env, is_by_id, repeat_flag
from latentplan.config.run_folder import lock_folder
from latentplan.envs import make_env
from latentplan.envs.vector import make_guarded_env
from latentplan.evaluation.compatibility import refuse_other_spaces
from latentplan.evaluation.episodes import OnStep, Step, episode_seed, iterate_episodes
from latentplan.evaluation.statistics import confidence_interval
from latentplan.models import Gaussian, State
from latentplan.models.heads import Actor
from latentplan.training.collection.collector import EnvFactory
from latentplan.training.console import StatusLine, own_command
from latentplan.training.distillation.labels import Demonstrations, plan_actions, read_first_actions
from latentplan.training.distillation.saves import KIND, open_saves, read_resumed
from latentplan.training.distillation.student import Student
from latentplan.training.run import Result
from latentplan.training.signals import Signals, exit_code, raise_interrupt
from latentplan.training.state import build, refuse_used, remove_leftovers, save_values

NUM_STAGES = 3  # per round: collect, train, select
NO_ROUND = -1  # value of `best_round` while the actor before distillation is the best
# Names of random streams, from which the starts of episodes derive; other names would change the results.
COLLECTED, SELECTING, TEST = "drive", "choose", "judge"


def distill(
    checkpoint: Path | str,
    folder: Path | str,
    settings: DistillConfig | None = None,
    *,
    planner: PlannerConfig | None = None,
    device: str = "cpu",
    make_env: EnvFactory | None = None,
    env: Mapping[str, Any] | None = None,
) -> Result:
    """Teaches a trained agent's actor to act as its planner does.

    Args:
        checkpoint: Folder of the agent, or of a run with an agent.
        folder: Folder for the distilled agent and the saved state.
        settings: Settings of the distillation; None takes the defaults.
        planner: Settings of the search that labels beliefs; None takes the agent's own. A deadline is ignored.
        device: "cpu" or "cuda".
        make_env: Makes the user's environment, as for `train`; None makes the environment of the agent.
        env: Fields of `latentplan.config.env_id.EnvChoice`, such as `{"id": "my_robot:Reach-v0"}`, for an agent whose
            environment has to be named again.

    Returns:
        The folder, and mean returns on the same test starts: `before`, `after`, `planner`, `planner_after`.

    Raises:
        UserError: The checkpoint, the folder or a setting cannot be used.
    """
    folder = Path(folder)
    refuse_used(folder, KIND, "--out")
    source = resolve_checkpoint(checkpoint)
    return _Distillation(source, folder, settings or DistillConfig(), planner, device, make_env, env).run()


def resume_distillation(
    folder: Path | str,
    *,
    rounds: int | None = None,
    minutes: float | None = None,
    device: str = "cpu",
    make_env: EnvFactory | None = None,
    env: Mapping[str, Any] | None = None,
) -> Result:
    """Continues a distillation from its last save.

    Args:
        folder: Folder of the distillation.
        rounds: New total number of rounds; None keeps the old number.
        minutes: New total budget of minutes; None keeps the old budget.
        device: "cpu" or "cuda".
        make_env: Makes the user's environment, as for `distill`.
        env: As for `distill`.

    Raises:
        UserError: The folder holds no distillation, or the agent that it started from has changed.
    """
    saved, settings, planner = read_resumed(folder, rounds=rounds, minutes=minutes)
    run = _Distillation(Path(saved["source"]), Path(folder), settings, planner, device, make_env, env)
    run.load(saved)
    return run.run()


@dataclass
class DistillationState:
    """Progress and results of a distillation.

    Attributes:
        stage: Stages done, three per round.
        minutes: Wall-clock minutes spent, over all processes.
        decisions: Decisions collected.
        loss: Mean imitation loss over the updates of the last round, in nats.
        best_return: Mean return of the best actor on the selection starts.
        best_round: The round that made the best actor, from 0; -1 for the actor before distillation.
        before: Returns of the actor before distillation on the test starts.
        planner: Returns of the planner on the test starts; empty until the first evaluation is done.
    """

    stage: int = 0
    minutes: float = 0.0
    decisions: int = 0
    loss: float = float("nan")
    best_return: float = float("-inf")
    best_round: int = NO_ROUND
    before: list[float] = field(default_factory=list)
    planner: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class Comparison:
    """Returns before and after a distillation, on the same test starts, which took no part in the selection.

    Attributes:
        before: Returns of the actor before distillation.
        planner: Returns of the planner with that actor's proposals.
        after: Returns of the selected actor; None if no round improved on the actor before distillation.
        planner_after: Returns of the planner with the selected actor's proposals; None like `after`.
    """

    before: Sequence[float]
    planner: Sequence[float]
    after: Sequence[float] | None = None
    planner_after: Sequence[float] | None = None

    @property
    def is_better(self) -> bool:
        """Whether the selected actor gains return, and gains more than the planner loses."""
        if self.after is None or self.planner_after is None:
            return False
        gain = np.mean(self.after) - np.mean(self.before)
        return bool(gain > 0.0 and gain + np.mean(self.planner_after) - np.mean(self.planner) > 0.0)

    def describe(self, chosen_round: int) -> list[str]:
        """Lines with the mean returns, their differences, and which actor is kept.

        Args:
            chosen_round: Number of the round that made the selected actor, from 1.
        """
        played = {
            "actor before": self.before,
            "actor after": self.after,
            "planner before": self.planner,
            "planner after": self.planner_after,
        }
        lines = [f"on the same {len(self.before)} test starts for all, which took no part in the selection:"]
        lines += [f"{name:<16}{format_mean(returns)}" for name, returns in played.items() if returns is not None]
        if self.after is None or self.planner_after is None:
            return [*lines, "no round improved on the actor before: the actor before is kept, unchanged"]
        gains = _differences(self.after, self.before)
        differences = {
            "actor, after - before": gains,
            "planner, after - before": _differences(self.planner_after, self.planner),
            "after, actor - planner": _differences(self.after, self.planner_after),
        }
        lines += [f"{name:<24}{format_mean(values, signed=True)}" for name, values in differences.items()]
        if np.mean(gains) <= 0.0:
            verdict = (
                f"the actor of round {chosen_round} was better on the selection starts, but not on the test starts"
            )
            return [*lines, f"{verdict}: the actor before is kept, unchanged"]
        if not self.is_better:
            return [*lines, "the planner loses more than the actor gains: the actor before is kept, unchanged"]
        lines.append(f"kept: the actor of round {chosen_round}")
        if confidence_interval(gains)[0] <= 0.0:
            lines.append("the 95 % interval of the actor's gain contains 0: more --evaluation-episodes would narrow it")
        return lines


class _Distillation:
    """A distillation with its agents, environment, labels, student and state."""

    def __init__(
        self,
        source: Path,
        folder: Path,
        settings: DistillConfig,
        planner: PlannerConfig | None,
        device: str,
        make_user_env: EnvFactory | None,
        env: Mapping[str, Any] | None,
    ) -> None:
        self.source, self.folder, self.settings = source, folder, settings
        self.model, self.config, self.info = load_model(source, device)
        if self.model.goal_dim:
            raise UserError(
                f"{source} has learned goals with its present actor: run scripts/distill.py before scripts/goals.py"
            )
        if self.model.has_choices:
            raise UserError(
                f"{source} has discrete actions, and only continuous actions are distilled: the actor that its run "
                "learned acts with --mode actor"
            )
        if self.model.spaces.vector_dim:
            raise UserError(f"{source} was trained with env.vectors, and only agents of pictures alone are distilled")
        self.model.requires_grad_(False)
        self.planner_config = replace(planner or self.config.planner, deadline_ms=None)
        self.planning = PlanningAgent(self.model, self.config, self.info["discount"], planner=self.planner_config)
        self.acting = ActorAgent(self.model, self.config)
        chosen = choose_env(self.config.env, env or {}, must_match=True)
        is_foreign = make_user_env is not None or is_by_id(chosen)
        self.env: Any = make_guarded_env(chosen, make_env=make_user_env) if is_foreign else make_env(chosen, 0)
        try:
            refuse_other_spaces(self.env, f"{chosen.domain}-{chosen.task}", self.model.action_dim, self.model.spaces)
        except UserError:
            self.env.close()
            raise
        self.state, self.demonstrations = DistillationState(), Demonstrations()
        self.student = Student(cast(Actor, self.model.actor), settings)
        self.initial = self.best = copy.deepcopy(self.model.actor.state_dict())
        self.line = StatusLine()
        self.saves = open_saves(folder)
        self._started = time.monotonic()
        self._earlier_minutes = 0.0

    def run(self) -> Result:
        """Run the remaining rounds and save the better agent; after an interruption, print how to resume."""
        state = self.state
        signals = Signals(raise_interrupt)
        try:
            with lock_folder(self.folder), self.line, signals:
                remove_leftovers(self.folder)
                if not state.planner:
                    self._evaluate_initial()
                while not self._is_spent():
                    round_index, stage = divmod(state.stage, NUM_STAGES)
                    (self._collect, self._train, self._select)[stage](round_index)
                    state.stage += 1
                    self._save()
                return Result(self.folder, 0, self._finish())
        except KeyboardInterrupt:
            command = f"{own_command('distill')} --resume {self.folder}{repeat_flag(self.config.env)}"
            if self.config.env.domain == USER_DOMAIN:
                command = f'latentplan.training.resume_distillation("{self.folder}", make_env=...)'
            self.line.print(f"stopped; to resume: {command}")
            return Result(self.folder, exit_code(signals.received), {})
        finally:
            self.env.close()

    def load(self, saved: dict[str, Any]) -> None:
        """Load what `_save` saved.

        Raises:
            UserError: The saved weights or labels do not fit the agent.
        """
        self.saves.newest()  # which the next save keeps
        self.state = build(DistillationState, saved["state"], self.folder)
        if not (math.isfinite(self.state.minutes) and self.state.minutes >= 0.0 and self.state.stage >= 0):
            raise UserError(f"the last save in {self.folder} is damaged: its clocks are outside of their ranges")
        self._earlier_minutes = self.state.minutes
        try:
            self.demonstrations.load_state_dict(saved["demonstrations"])
            self.model.actor.load_state_dict(saved["best"])
            self.student.load_state_dict(saved["student"])
        except (RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[-1].strip()
            raise UserError(
                f"what is saved in {self.folder} does not fit the agent of {self.source}: {reason}"
            ) from None
        self.best = saved["best"]
        self.model.actor.load_state_dict(self.student.weights())

    def _evaluate_initial(self) -> None:
        """Evaluate the actor and the planner before the first round."""
        self._save()  # an interruption from here on can be resumed
        state = self.state
        state.before = self._play(self.acting, TEST, "the actor")
        state.best_return = float(np.mean(self._play(self.acting, SELECTING, "the actor")))
        state.planner = self._play(self.planning, TEST, "the planner")
        self.line.print(f"actor    {format_mean(state.before)}\nplanner  {format_mean(state.planner)}")
        if np.mean(state.planner) <= np.mean(state.before):
            self.line.print("the planner earns no more than the actor: an improvement is not to be expected")
        self._save()

    def _collect(self, round_index: int) -> None:
        """Play episodes, and store their beliefs with the planner's first actions; renew the oldest labels."""
        settings = self.settings
        agent: ModelAgent = self.planning if round_index < settings.planner_rounds else self.acting
        seed = derive_seed(settings.seed, "label", round_index)
        generator = torch.Generator(self.model.device).manual_seed(seed)
        states: list[State] = []
        plans: list[Gaussian] = []

        def store_belief(step: Step) -> None:
            if step.action is not None and agent.state is not None:
                states.append(agent.state)
                plan = self.planning.controller.plan
                if agent is self.planning and plan is not None:
                    plans.append(read_first_actions(plan, self.planner_config.min_std))

        self._play(agent, COLLECTED, "collecting", round_index, settings.episodes, store_belief)
        num_stale = int(settings.relabel_share * len(self.demonstrations))
        if num_stale:
            stale = self.demonstrations.oldest(num_stale)
            actions = self._plan(self.demonstrations.states(stale), generator)
            self.demonstrations.replace(stale, actions, round_index)
        visited = State(*(torch.cat(part) for part in zip(*states, strict=True)))
        planned = Gaussian(*(torch.cat(part) for part in zip(*plans, strict=True))) if plans else None
        self.demonstrations.add(visited, planned or self._plan(visited, generator), round_index)
        self.state.decisions += len(states)

    def _train(self, round_index: int) -> None:
        """Train the student on all labels, and act with its weights from now on."""

        def show(done: int, loss: float) -> None:
            self._show(f"learning {done} of {self.settings.updates} | loss {loss:.3f}")

        self.state.loss = self.student.learn(self.demonstrations, round_index, show)
        self.model.actor.load_state_dict(self.student.weights())

    def _select(self, round_index: int) -> None:
        """Keep the actor if it is the best so far on the selection starts."""
        state = self.state
        returns = self._play(self.acting, SELECTING, "evaluating")
        mean = float(np.mean(returns))
        if mean > state.best_return:
            state.best_return, state.best_round = mean, round_index
            self.best = copy.deepcopy(self.model.actor.state_dict())
        self.line.print(
            f"round {round_index + 1:>2}  {len(self.demonstrations):>7,} beliefs  loss {state.loss:7.3f} nats  "
            f"actor {format_mean(returns)}{'  best' if state.best_round == round_index else ''}"
        )

    def _finish(self) -> dict[str, float]:
        """Evaluate the best actor on the test starts, and save the agent with it only if it is better there too."""
        state = self.state
        comparison = Comparison(state.before, state.planner)
        if state.best_round != NO_ROUND:
            self.model.actor.load_state_dict(self.best)
            after = self._play(self.acting, TEST, "evaluating the best actor")
            planner_after = self._play(self.planning, TEST, "the planner with the best actor")
            comparison = replace(comparison, after=after, planner_after=planner_after)
        is_better = comparison.is_better
        self.model.actor.load_state_dict(self.best if is_better else self.initial)
        kept = comparison if is_better else replace(comparison, after=state.before, planner_after=state.planner)
        returns = asdict(kept)
        facts = {
            "rounds": state.stage // NUM_STAGES,
            "decisions": state.decisions,
            "kept_round": state.best_round + 1 if is_better else None,
            **{f"returns_{name}": values for name, values in returns.items()},
            "settings": to_dict(self.settings),
            "planner": to_dict(self.planner_config),
            "from_sha256": self.info["sha256"],
        }
        save_checkpoint(self.folder, self.model, self.config, self.info | {"distilled": facts})
        for line in [*comparison.describe(state.best_round + 1), f"agent: {self.folder}"]:
            self.line.print(line)
        return {name: float(np.mean(values)) for name, values in returns.items()}

    def _play(
        self,
        agent: ModelAgent,
        starts: str,
        activity: str,
        counter: int = 0,
        num_episodes: int | None = None,
        on_step: OnStep | None = None,
    ) -> list[float]:
        """Plays episodes, and returns their returns.

        Args:
            agent: Acts in the episodes.
            starts: Name of the random stream from which the starts derive.
            activity: Text for the status line.
            counter: Number that separates the streams of one name.
            num_episodes: Number of episodes; None takes `evaluation_episodes`.
            on_step: Called after every step.
        """
        num_episodes = num_episodes or self.settings.evaluation_episodes
        stream = derive_seed(self.settings.seed, starts, counter)
        seeds = [episode_seed(stream, index) for index in range(num_episodes)]
        returns: list[float] = []
        self._show(f"{activity}: episode 1 of {num_episodes}")
        for episode in iterate_episodes(self.env, agent, seeds, on_step=on_step):
            returns.append(episode.total_return)
            self._show(f"{activity}: episode {min(len(returns) + 1, num_episodes)} of {num_episodes}")
        return returns

    def _plan(self, states: State, generator: torch.Generator) -> Gaussian:
        """The planner's first actions at beliefs (rows, ...)."""
        on_device = State(*(part.to(self.model.device) for part in states))
        total, rows = len(on_device.deter), self.settings.plan_batch

        def show(done: int) -> None:
            self._show(f"planning at {done:,} of {total:,} beliefs")

        return plan_actions(self.planning.controller.planner, self.planning.imagined, on_device, generator, rows, show)

    def _save(self) -> None:
        self.state.minutes = self._minutes()
        saved = {
            "source": str(self.source.resolve()),
            "sha256": self.info["sha256"],
            "settings": to_dict(self.settings),
            "planner": to_dict(self.planner_config),
            "state": asdict(self.state),
            "demonstrations": self.demonstrations.state_dict(),
            "student": self.student.state_dict(),
            "best": self.best,
        }
        round_index, stage = divmod(self.state.stage, NUM_STAGES)
        save_values(self.saves, saved, {"round": round_index, "stage": stage})

    def _is_spent(self) -> bool:
        """Whether the budget allows no further round; a round that has begun is finished."""
        round_index, stage = divmod(self.state.stage, NUM_STAGES)
        is_late = self.settings.minutes is not None and self._minutes() >= self.settings.minutes
        return stage == 0 and (is_late or round_index >= self.settings.rounds)

    def _minutes(self) -> float:
        return self._earlier_minutes + (time.monotonic() - self._started) / 60.0

    def _show(self, activity: str) -> None:
        round_index = min(self.state.stage // NUM_STAGES + 1, self.settings.rounds)
        self.line.update(f"round {round_index} of {self.settings.rounds} | {activity} | {self._minutes():.1f} min")


def format_mean(returns: Sequence[float], *, signed: bool = False) -> str:
    """The mean of returns with its 95 % interval, as text; `signed` writes a plus sign, for differences."""
    low, high = confidence_interval(returns)
    sign = "+" if signed else ""
    if math.isnan(low):
        return f"{np.mean(returns):{sign}8.1f}"
    return f"{np.mean(returns):{sign}8.1f}  (95 % interval {low:{sign}.1f} to {high:{sign}.1f})"


def _differences(late: Sequence[float], early: Sequence[float]) -> list[float]:
    return [one - other for one, other in zip(late, early, strict=True)]
