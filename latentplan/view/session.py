"""A running simulation and the agent that acts in it, whose goal, search and mode change between two decisions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from latentplan.agents.checkpoint import make_loaded_agent
from latentplan.agents.modes import MODES, planning_modes
from latentplan.config import Config, PlannerConfig, UserError, derive_seed, to_dict
from latentplan.config.planner import override_planner
from latentplan.evaluation.episodes import episode_seed, see
from latentplan.evaluation.goals import Goals, ScoredEnv, read_goals, score_env
from latentplan.models import WorldModel
from latentplan.reporting.frame import Frame
from latentplan.reporting.recorder import choose_candidates, spread
from latentplan.reporting.report import tile
from latentplan.view.pictures import GoalPictures

Floats = NDArray[np.float32]
PUSH_S = 0.2  # simulated seconds that a push lasts
MOST_WEIGHTS = 10.0  # of the body, as the largest force: larger ones break the simulation
NUM_PICTURES = 5  # of the imagined future
WARM_UP_DECISIONS = 3
DEFAULT_HZ = 20.0  # of an environment that does not tell its rate


@dataclass(frozen=True)
class Settings:
    """What can change while the simulation runs.

    Attributes:
        mode: Agent that chooses the actions; a name in `latentplan.agents.modes.MODES`.
        objective: Objective in place of the task; None is the task. `goal:NAME` names a picture in `GoalPictures`.
        constraint: Conditions that must hold at every moment; None without.
        planner: Settings of the search in place of the agent's own, by name.
    """

    mode: str = "planner"
    objective: str | None = None
    constraint: str | None = None
    planner: Mapping[str, Any] = field(default_factory=dict)


class Trained(NamedTuple):
    """What `latentplan.agents.checkpoint.load_model` returns: the world model, its settings and its description."""

    model: WorldModel
    config: Config
    info: Mapping[str, Any]


class Fan(NamedTuple):
    """The last iteration of a search.

    Attributes:
        candidates: Some candidates that are no elites, (sample, horizon, action).
        elites: Some elites, (elite, horizon, action).
        mean: Mean of the search distribution, (horizon, action).
    """

    candidates: Floats
    elites: Floats
    mean: Floats


class Future(NamedTuple):
    """What the model imagines from the belief at one decision.

    Attributes:
        steps: Model steps of the pictures, from 1.
        picture: Decoded states, uint8 (height, width, 3): a row for each way of acting, a column for each step.
        rewards: Predicted sum of rewards over the imagined steps for each row, by its name: "plan" or "actor".
        num_steps: Model steps that were imagined.
        fan: The search; None where none was made in this process at this decision.
    """

    steps: list[int]
    picture: Frame
    rewards: dict[str, float]
    num_steps: int
    fan: Fan | None


@dataclass(frozen=True)
class Moment:
    """One decision, after the agent chose its action and before the simulator moves.

    Attributes:
        episode: Number of the episode, from 1.
        decision: Number of the decision in its episode, from 0.
        total_return: Sum of the rewards of the episode so far.
        frame: First picture that the agent sees, uint8 (height, width, 3).
        action: The action, (action,).
        source: Origin of the action: "plan", "tail" or "actor".
        decision_ms: Milliseconds that the agent took.
        surprise: Surprise of the frame in nats; None for an agent without a world model.
        quantities: True quantities of the body, by name.
        score: Score of the objective at the last env frame; None without an objective.
        clauses: Clauses of the objective and constraints, and whether each was met at the last env frame.
        is_pushed: Whether a push acts on the body.
        future: What the model imagines; None where it was not asked for.
    """

    episode: int
    decision: int
    total_return: float
    frame: Frame
    action: Floats
    source: str
    decision_ms: float
    surprise: float | None
    quantities: dict[str, float]
    score: float | None
    clauses: list[tuple[str, bool]]
    is_pushed: bool
    future: Future | None


class Session:
    """Episodes of an agent without an end; nothing but `decide` moves the simulator.

    Episode i starts as episode i of an evaluation with the same seed does.

    Attributes:
        settings: The present settings.
        search: The settings of the search, complete.
        agent: The agent that acts.
        pictures: Goal pictures that objectives can name.
        period_s: Simulated seconds of one decision.

    Args:
        env: The environment; the caller closes it.
        domain: Domain of the environment, whose quantities goals can name.
        trained: The agent's model.
        settings: The first settings.
        pictures: Goal pictures.
        seed: Seed of the starts, at least 0.

    Raises:
        UserError: The settings cannot be used.
    """

    def __init__(
        self,
        env: Any,
        domain: str,
        trained: Trained,
        settings: Settings,
        pictures: GoalPictures,
        *,
        seed: int = 0,
    ) -> None:
        self.domain = domain
        self.env, self.trained, self.pictures, self.seed = env, trained, pictures, seed
        self.period_s = 1.0 / float(env.unwrapped.metadata.get("render_fps") or DEFAULT_HZ)
        self.agent: Any = None
        self.settings, self.search = settings, self._read_search(settings)
        self._goals: Goals | None = None
        self._world: Any = env
        self._episode, self._is_over, self._push_left = 0, True, 0
        self._decision, self._total = 0, 0.0
        self._frame: Any = None
        self._info: dict[str, Any] = {}
        self.change(settings)
        wait_until_ready = getattr(self.agent, "wait_until_ready", None)
        if wait_until_ready is not None:
            wait_until_ready()

    @property
    def is_planning(self) -> bool:
        """Whether the agent plans, and so pursues an objective."""
        return self.settings.mode in planning_modes()

    @property
    def weight(self) -> float | None:
        """Weight of the body in newtons; None where it cannot be pushed."""
        return getattr(self.env.unwrapped, "weight", None)

    def change(self, wanted: Settings) -> None:
        """Takes other settings from the next decision on; a schedule of objectives begins anew.

        Raises:
            UserError: The settings cannot be used; those before are kept.
        """
        search = self._read_search(wanted)
        goals = read_goals(self.pictures.resolve(wanted.objective), wanted.constraint, self.domain)
        has_same_agent = self.agent is not None and self._agent_of(wanted) == self._agent_of(self.settings)
        agent = self.agent if has_same_agent else self._make_agent(wanted)
        try:
            world = self._pass_on(goals, agent, wanted)
        except UserError:
            if has_same_agent:
                self._pass_on(self._goals, agent, self.settings)
                if isinstance(self._world, ScoredEnv):
                    self._world.repeat_objective()
            else:
                _close(agent)
            raise
        if not has_same_agent:
            _close(self.agent)
        if isinstance(world, ScoredEnv):
            world.restart_score()
        self.agent, self.settings, self.search, self._goals, self._world = agent, wanted, search, goals, world

    def push(self, force: float) -> None:
        """Pushes the body for `PUSH_S`, from the next step of the simulator on.

        Args:
            force: Force in newtons along the world's x axis.

        Raises:
            UserError: The environment cannot push the body, or the force is too large.
        """
        self.check_push(force)
        self.env.unwrapped.push((force, 0.0, 0.0))
        self._push_left = max(1, round(PUSH_S / self.period_s))

    def check_push(self, force: float) -> None:
        """Checks that the body can be pushed with a force in newtons.

        Raises:
            UserError: The environment cannot push the body, or the force is too large.
        """
        if self.weight is None:
            raise UserError("this environment cannot push its body")
        most = MOST_WEIGHTS * self.weight
        if not abs(force) <= most:
            raise UserError(f"a push must be within {-most:.0f} and {most:.0f} N, ten times the weight, got {force}")

    def restart(self) -> None:
        """Begins the next episode with the next decision."""
        self._is_over = True

    def decide(self, looks_ahead: bool = False) -> Moment:
        """Lets the agent decide, and moves the simulator by one decision.

        Args:
            looks_ahead: Whether the model imagines the future too.
        """
        if self._is_over:
            self._begin_episode()
        controller = getattr(self.agent, "controller", None)
        if controller is not None:
            controller.keep = "candidates" if looks_ahead else None
        started = time.perf_counter()
        action = self.agent.act(see(self._frame, self._info))
        decision_ms = 1000.0 * (time.perf_counter() - started)
        moment = self._describe(action, decision_ms, self._look_ahead() if looks_ahead else None)
        self._frame, reward, terminated, truncated, self._info = self._world.step(action)
        self._total += float(reward)
        self._decision += 1
        self._is_over = terminated or truncated
        self._push_left -= 1
        if self._push_left == 0:
            self.env.unwrapped.push((0.0, 0.0, 0.0))
        return moment

    def warm_up(self) -> None:
        """Makes a few decisions that do not count, because the first calls of libraries are slow."""
        for _ in range(WARM_UP_DECISIONS):
            self.decide(looks_ahead=True)
        self._episode, self._is_over = 0, True

    def present_frame(self) -> Frame:
        """The first picture that the agent saw last, uint8 (height, width, 3)."""
        frame: Frame = self._frame[..., :3]
        return frame

    def close(self) -> None:
        """Ends the agent's processes."""
        _close(self.agent)

    def _begin_episode(self) -> None:
        seed = episode_seed(self.seed, self._episode)
        self._frame, self._info = self._world.reset(seed=seed)
        self.agent.reset()
        self.agent.seed(derive_seed(seed, "agent"))
        self._episode, self._decision, self._total, self._is_over, self._push_left = self._episode + 1, 0, 0.0, False, 0

    def _read_search(self, settings: Settings) -> PlannerConfig:
        try:
            return PlannerConfig(**override_planner(to_dict(self.trained.config.planner), settings.planner))
        except (TypeError, ValueError) as error:
            raise UserError(str(error)) from None

    @staticmethod
    def _agent_of(settings: Settings) -> tuple[Any, ...]:
        """The settings for which another agent is made."""
        return settings.mode, dict(settings.planner) if MODES[settings.mode].plans else {}

    def _make_agent(self, wanted: Settings) -> Any:
        """An agent that goes on from what the present one knows of the episode."""
        mode, planner = self._agent_of(wanted)
        agent: Any = make_loaded_agent(*self.trained, mode, **planner)
        if hasattr(agent, "set_memory") and hasattr(self.agent, "memory"):
            agent.set_memory(agent.memory() | self.agent.memory())
        return agent

    def _pass_on(self, goals: Goals | None, agent: Any, settings: Settings) -> Any:
        """Gives the goals to the agent, if it plans; returns the environment that scores them."""
        planner = agent if MODES[settings.mode].plans else None
        if goals is not None:
            return score_env(self.env, goals, planner)
        if planner is not None:
            planner.set_objective()
        return self.env

    def _describe(self, action: Floats, decision_ms: float, future: Future | None) -> Moment:
        world = self._world if isinstance(self._world, ScoredEnv) else None
        names = getattr(self.env.unwrapped, "labels", None) or {}
        values = self._info.get("labels", ())
        return Moment(
            episode=self._episode,
            decision=self._decision,
            total_return=self._total,
            frame=self.present_frame(),
            action=action,
            source=getattr(self.agent, "last_source", "actor"),
            decision_ms=decision_ms,
            surprise=self.agent.surprise() if hasattr(self.agent, "surprise") else None,
            quantities=dict(zip(names, map(float, values), strict=False)),
            score=world.objective_scores[-1] if world is not None and world.objective_scores else None,
            clauses=[] if world is None else list(world.clauses),
            is_pushed=self._push_left > 0,
            future=future,
        )

    def _look_ahead(self) -> Future | None:
        """What the model imagines along the plan, where there is one, and along the actor."""
        if not hasattr(self.agent, "imagine_along"):
            return None
        planned, belief = self.agent.plan_actions(), self.agent.belief()
        num_steps = self.search.horizon if planned is None else planned.shape[1]
        shown, imagined = spread(num_steps, NUM_PICTURES), {}
        if planned is not None:
            imagined["plan"] = self.agent.imagine_along([belief], planned.float().cpu().numpy(), num_steps, shown)
        imagined["actor"] = self.agent.imagine_along([belief], None, num_steps, shown)
        return Future(
            steps=[step + 1 for step in shown],
            picture=tile([each.pictures[0] for each in imagined.values()]),
            rewards={name: float(each.rewards.sum()) for name, each in imagined.items()},
            num_steps=num_steps,
            fan=self._read_fan(),
        )

    def _read_fan(self) -> Fan | None:
        plan = getattr(getattr(self.agent, "controller", None), "plan", None)
        if plan is None or not plan.candidates or self.agent.last_source != "plan":
            return None
        last = plan.candidates[-1]
        candidates, elites = choose_candidates(last)
        return Fan(candidates, elites, last.mean[0].float().cpu().numpy())


def _close(agent: Any) -> None:
    """Ends the processes of an agent that has some."""
    if hasattr(agent, "close"):
        agent.close()
