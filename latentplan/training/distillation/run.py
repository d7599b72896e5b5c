"""The planner taught to the actor: rounds of driving, labelling and learning (DAgger, Ross et al. 2011, section 3).

The world model, the value and all else stay as they are. A round has three stages: `drive` (episodes, whose every
belief is labelled with the planner's first action), `learn` (from all that was ever labelled) and `judge`. A run is
saved after each stage, and each stage draws from random streams of its own, so that an interrupted run loses at most
one stage and goes on as if nothing had happened.
"""

from __future__ import annotations

import copy
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from latentplan.agents.actor import ActorAgent
from latentplan.agents.base import ModelAgent
from latentplan.agents.checkpoint import load_model, read_info, resolve_checkpoint, save_checkpoint
from latentplan.agents.planning import PlanningAgent
from latentplan.config import USER_DOMAIN, DistillConfig, PlannerConfig, UserError, derive_seed, to_dict
from latentplan.config.planner import drop_removed
from latentplan.envs import make_env, make_from
from latentplan.evaluation.episodes import OnStep, Step, episode_seed, iterate_episodes
from latentplan.models import Gaussian, State
from latentplan.training.collection.collector import EnvFactory
from latentplan.training.console import StatusLine
from latentplan.training.distillation.comparison import Comparison, describe_mean
from latentplan.training.distillation.labels import Demonstrations, first_actions, plan_actions
from latentplan.training.distillation.standing import START, STATE_FILE, Standing, load_distillation, save_distillation
from latentplan.training.distillation.student import Student
from latentplan.training.folder import claim, refuse_used
from latentplan.training.state import INTERRUPTED
from latentplan.training.train import Result

STAGES = ("drive", "learn", "judge")


def distill(
    checkpoint: Path | str,
    folder: Path | str,
    settings: DistillConfig | None = None,
    *,
    planner: PlannerConfig | None = None,
    device: str = "cpu",
    make_env: EnvFactory | None = None,
) -> Result:
    """Teach a trained agent's actor what its planner does.

    Args:
        checkpoint: The agent, or a run that holds one.
        folder: Where the distilled agent goes, and what it takes to resume.
        settings: Of the distillation.
        planner: Settings of the search that labels; None takes the agent's own. A deadline is lifted: nothing waits.
        device: `cpu` or `cuda`.
        make_env: The user's environment, as given to `train`; None takes the suite's task it was trained on.

    Returns:
        Where the agent lies, and mean returns on the same starts: `before`, `after`, `planner`, `planner_after`.

    Raises:
        UserError: The checkpoint, the folder or a setting cannot be used.
    """
    folder = Path(folder)
    refuse_used(folder, str(STATE_FILE), "--out")
    source = resolve_checkpoint(checkpoint)
    return _Distillation(source, folder, settings or DistillConfig(), planner, device, make_env).run()


def resume_distillation(
    folder: Path | str,
    *,
    rounds: int | None = None,
    minutes: float | None = None,
    device: str = "cpu",
    make_env: EnvFactory | None = None,
) -> Result:
    """Continue a distillation where it was last saved.

    Args:
        folder: Its folder.
        rounds: New number of rounds in all; None keeps the old one.
        minutes: New budget of minutes in all; None keeps the old one.
        device: `cpu` or `cuda`.
        make_env: As given to `distill`.

    Raises:
        UserError: The folder holds no distillation, or the agent it began with has changed.
    """
    saved = load_distillation(Path(folder))
    if read_info(saved["source"])["sha256"] != saved["sha256"]:
        raise UserError(f"{saved['source']} is not the agent that the distillation in {folder} began with")
    settings = DistillConfig(**saved["settings"])
    settings = replace(settings, rounds=rounds or settings.rounds, minutes=minutes or settings.minutes)
    planner = PlannerConfig(**drop_removed(saved["planner"]))
    run = _Distillation(Path(saved["source"]), Path(folder), settings, planner, device, make_env)
    run.load(saved)
    return run.run()


class _Distillation:
    def __init__(
        self,
        source: Path,
        folder: Path,
        settings: DistillConfig,
        planner: PlannerConfig | None,
        device: str,
        make_user_env: EnvFactory | None,
    ) -> None:
        self.source, self.folder, self.settings = source, folder, settings
        self.model, self.config, self.info = load_model(source, device)
        if self.model.goal_dim:
            raise UserError(f"{source} has learned goals, which build on its actor: distill before scripts/goals.py")
        self.model.requires_grad_(False)
        self.planner_config = replace(planner or self.config.planner, deadline_ms=None)
        self.planning = PlanningAgent(self.model, self.config, self.info["discount"], planner=self.planner_config)
        self.acting = ActorAgent(self.model, self.config)
        build = make_env if make_user_env is None else make_from(make_user_env)
        self.env = build(self.config.env, 0)
        self.standing, self.demonstrations = Standing(), Demonstrations()
        self.student = Student(self.model.actor, settings)
        self.start = self.best = copy.deepcopy(self.model.actor.state_dict())
        self.line = StatusLine()
        self._started = time.monotonic()
        self._earlier_minutes = 0.0

    def run(self) -> Result:
        """Go through what is left of the rounds, then compare; an interrupted run says how to go on."""
        standing = self.standing
        try:
            with claim(self.folder), self.line:
                if not standing.planner:
                    self._begin()
                while not self._is_spent():
                    round_index, stage = divmod(standing.stage, len(STAGES))
                    getattr(self, f"_{STAGES[stage]}")(round_index)
                    standing.stage += 1
                    self._save()
                return Result(self.folder, 0, self._finish())
        except KeyboardInterrupt:
            command = f"python scripts/distill.py --resume {self.folder}"
            if self.config.env.domain == USER_DOMAIN:
                command = f'latentplan.training.resume_distillation("{self.folder}", make_env=...)'
            self.line.print(f"stopped; to go on: {command}")
            return Result(self.folder, INTERRUPTED, {})
        finally:
            self.env.close()

    def load(self, saved: dict[str, Any]) -> None:
        """Take up what `_save` wrote."""
        self.standing = Standing(**saved["standing"])
        self._earlier_minutes = self.standing.minutes
        self.demonstrations.load_state_dict(saved["demonstrations"])
        self.student.load_state_dict(saved["student"])
        self.best = saved["best"]
        self.model.actor.load_state_dict(self.student.weights())

    def _begin(self) -> None:
        """What the actor and the planner earn to begin with."""
        self._save()  # from here on there is something to resume
        standing = self.standing
        standing.before = self._play(self.acting, "judge", "the actor")
        standing.best_return = float(np.mean(self._play(self.acting, "choose", "the actor")))
        standing.planner = self._play(self.planning, "judge", "the planner")
        self.line.print(f"actor    {describe_mean(standing.before)}\nplanner  {describe_mean(standing.planner)}")
        if np.mean(standing.planner) <= np.mean(standing.before):
            self.line.print("the planner earns no more than its pupil: an improvement is not to be expected")
        self._save()

    def _drive(self, round_index: int) -> None:
        """Play episodes, and store the beliefs on the way with what the planner would do there."""
        settings = self.settings
        agent: ModelAgent = self.planning if round_index < settings.planner_rounds else self.acting
        seed = derive_seed(settings.seed, "label", round_index)
        generator = torch.Generator(self.model.device).manual_seed(seed)
        states: list[State] = []
        plans: list[Gaussian] = []

        def remember(step: Step) -> None:
            if step.action is not None and agent.state is not None:
                states.append(agent.state)
                plan = self.planning.controller.plan
                if agent is self.planning and plan is not None:
                    plans.append(first_actions(plan, self.planner_config.min_std))

        self._play(agent, "drive", "driving", round_index, settings.episodes, remember)
        num_stale = int(settings.relabel_share * len(self.demonstrations))
        if num_stale:
            stale = self.demonstrations.oldest(num_stale)
            actions = self._plan(self.demonstrations.states(stale), generator)
            self.demonstrations.replace(stale, actions, round_index)
        visited = State(*(torch.cat(part) for part in zip(*states, strict=True)))
        planned = Gaussian(*(torch.cat(part) for part in zip(*plans, strict=True))) if plans else None
        self.demonstrations.add(visited, planned or self._plan(visited, generator), round_index)
        self.standing.decisions += len(states)

    def _learn(self, round_index: int) -> None:
        """Let the student learn from everything stored, and act from now on."""

        def show(done: int, loss: float) -> None:
            self._show(f"learning {done} of {self.settings.updates} | loss {loss:.3f}")

        self.standing.loss = self.student.learn(self.demonstrations, round_index, show)
        self.model.actor.load_state_dict(self.student.weights())

    def _judge(self, round_index: int) -> None:
        """Keep the actor if it is the best so far on the starts that choose."""
        standing = self.standing
        returns = self._play(self.acting, "choose", "judging")
        mean = float(np.mean(returns))
        if mean > standing.best_return:
            standing.best_return, standing.best_round = mean, round_index
            self.best = copy.deepcopy(self.model.actor.state_dict())
        self.line.print(
            f"round {round_index + 1:>2}  {len(self.demonstrations):>7,} beliefs  loss {standing.loss:7.3f} nats  "
            f"actor {describe_mean(returns)}{'  best' if standing.best_round == round_index else ''}"
        )

    def _finish(self) -> dict[str, float]:
        """Judge the best actor on starts that chose nothing, and keep it only if it is better there too."""
        standing = self.standing
        found = Comparison(standing.before, standing.planner)
        if standing.best_round != START:
            self.model.actor.load_state_dict(self.best)
            after = self._play(self.acting, "judge", "judging the best actor")
            found = replace(found, after=after, planner_after=self._play(self.planning, "judge", "the planner with it"))
        self.model.actor.load_state_dict(self.best if found.is_better else self.start)
        kept = found if found.is_better else Comparison(found.before, found.planner, found.before, found.planner)
        returns = asdict(kept)
        facts = {
            "rounds": standing.stage // len(STAGES),
            "decisions": standing.decisions,
            "kept_round": standing.best_round + 1 if found.is_better else None,
            **{f"returns_{name}": values for name, values in returns.items()},
            "settings": to_dict(self.settings),
            "planner": to_dict(self.planner_config),
            "from_sha256": self.info["sha256"],
        }
        save_checkpoint(self.folder, self.model, self.config, self.info | {"distilled": facts})
        for line in [*found.describe(standing.best_round + 1), f"agent: {self.folder}"]:
            self.line.print(line)
        return {name: float(np.mean(values)) for name, values in returns.items()}

    def _play(
        self,
        agent: ModelAgent,
        starts: str,
        what: str,
        counter: int = 0,
        num_episodes: int | None = None,
        on_step: OnStep | None = None,
    ) -> list[float]:
        """Returns of episodes from the starts of a name and counter."""
        num_episodes = num_episodes or self.settings.evaluation_episodes
        stream = derive_seed(self.settings.seed, starts, counter)
        seeds = [episode_seed(stream, index) for index in range(num_episodes)]
        returns: list[float] = []
        self._show(f"{what}: episode 1 of {num_episodes}")
        for episode in iterate_episodes(self.env, agent, seeds, on_step=on_step):
            returns.append(episode.total_return)
            self._show(f"{what}: episode {min(len(returns) + 1, num_episodes)} of {num_episodes}")
        return returns

    def _plan(self, states: State, generator: torch.Generator) -> Gaussian:
        """The planner's first actions at beliefs (rows, ...)."""
        here = State(*(part.to(self.model.device) for part in states))
        total, rows = len(here.deter), self.settings.plan_batch

        def show(done: int) -> None:
            self._show(f"planning at {done:,} of {total:,} beliefs")

        return plan_actions(self.planning.controller.planner, self.planning.imagined, here, generator, rows, show)

    def _save(self) -> None:
        self.standing.minutes = self._minutes()
        saved = {
            "source": str(self.source.resolve()),
            "sha256": self.info["sha256"],
            "settings": to_dict(self.settings),
            "planner": to_dict(self.planner_config),
            "standing": asdict(self.standing),
            "demonstrations": self.demonstrations.state_dict(),
            "student": self.student.state_dict(),
            "best": self.best,
        }
        save_distillation(self.folder, saved)

    def _is_spent(self) -> bool:
        """Whether no round may begin; one that has begun is finished."""
        round_index, stage = divmod(self.standing.stage, len(STAGES))
        late = self.settings.minutes is not None and self._minutes() >= self.settings.minutes
        return stage == 0 and (late or round_index >= self.settings.rounds)

    def _minutes(self) -> float:
        return self._earlier_minutes + (time.monotonic() - self._started) / 60.0

    def _show(self, what: str) -> None:
        round_index = min(self.standing.stage // len(STAGES) + 1, self.settings.rounds)
        self.line.update(f"round {round_index} of {self.settings.rounds} | {what} | {self._minutes():.1f} min")
