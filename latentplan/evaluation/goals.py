"""Scores of episodes for objectives and constraints, computed from the true state of the simulator.

A score uses no prediction of a model: it is computed from the quantities that the environment reports after every
control step, and for a goal image from the camera's frames. The score therefore does not depend on the agent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from latentplan.config import EnvConfig, UserError
from latentplan.config.quantities import scales
from latentplan.envs.true_quantities import clause_degree
from latentplan.objectives.expression import (
    Clause,
    Expression,
    GoalImage,
    LearnedReturn,
    Phase,
    evaluate,
    shortfall,
)
from latentplan.objectives.goal_image import read_goal_image
from latentplan.objectives.parser import parse_constraints, parse_schedule

if TYPE_CHECKING:
    from latentplan.envs import SuiteEnv

MET_DEGREE = 0.9  # degree from which a clause counts as met in films
PIXEL_MARGIN = 0.1  # root mean square difference to a goal image that counts as one margin; 1 is black to white


@dataclass(frozen=True)
class Goals:
    """Objectives and constraints of an evaluation.

    Attributes:
        phases: Objectives in the order of their start; empty for the objective of the training.
        constraints: Clauses that must hold at every control step.
        objective_text: The objectives as text, or None.
        constraint_text: The constraints as text, or None.
    """

    phases: tuple[Phase, ...]
    constraints: tuple[Clause, ...]
    objective_text: str | None
    constraint_text: str | None


@dataclass(frozen=True)
class Score:
    """The score of one episode.

    Attributes:
        objective_return: Sum of the objective over env frames; 0 without an objective.
        violation_rate: Share of env frames at which a constraint was broken, in [0, 1]; 0 without constraints.
        quantities: Mean of every true quantity over the env frames.
    """

    objective_return: float
    violation_rate: float
    quantities: dict[str, float]


def goal_env(config: EnvConfig) -> EnvConfig:
    """The settings of the training's environment, with the floor drawn behind the start as well.

    Without a floor behind the start, frames of a body that moves backwards would not show its speed.
    """
    return replace(config, floor="endless")


def read_goals(objective: str | None, constraint: str | None, domain: str) -> Goals | None:
    """Parses the texts of `--objective` and `--constraint`; None if they name neither an objective nor a constraint.

    Raises:
        UserError: A text is no expression over the domain's quantities, or a goal image cannot be read.
    """
    known = scales(domain)
    phases = () if objective is None else parse_schedule(objective, known)
    constraints = () if constraint is None else parse_constraints(constraint, known)
    if not phases and not constraints:
        return None
    for path in {path for phase in phases for path in _goal_image_paths(phase.objective)}:
        read_goal_image(path)
    return Goals(phases, constraints, objective, constraint)


class ScoredEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that scores every episode, and reports each change of the objective.

    Attributes:
        scores: Scores of the finished episodes, in order.
        objective_scores: Score of the objective at each env frame of the present episode.
        substeps_per_decision: Steps of the simulator per decision.
        clauses: Pairs of a text and a bool: each clause of the present objective, then each constraint, and whether it
            was met at the last env frame. Empty before the first env frame.
    """

    def __init__(self, env: SuiteEnv, goals: Goals, on_objective: Callable[[Expression], None] | None = None) -> None:
        """Wraps an environment.

        Args:
            env: The environment, which has to report true quantities.
            goals: The goals to score.
            on_objective: Called with the present objective when an episode begins and when the objective changes.

        Raises:
            UserError: The environment does not report true quantities, or a goal image cannot be compared with its
                frames, which show several cameras.
        """
        if not hasattr(env, "record_quantities"):
            raise UserError("goals are scored by true quantities, which this environment does not report")
        images = [path for phase in goals.phases for path in _goal_image_paths(phase.objective)]
        if images and env.spaces.cameras > 1:
            raise UserError(
                f"a goal image shows one camera, and the frames of this environment show {env.spaces.cameras}: name "
                "quantities instead"
            )
        super().__init__(env)
        self._suite_env, self.substeps_per_decision = env, env.substeps_per_decision
        env.record_quantities = True
        self.goals, self.scores = goals, list[Score]()
        self.objective_scores: list[float] = []
        self.clauses: list[tuple[str, bool]] = []
        self._on_objective = on_objective
        self._names = tuple(scales(env.domain))
        self._pictures = {path: read_goal_image(path, env.spaces.frame_size) for path in images}
        self._reported_phase: Phase | None = None
        self._num_frames = self._num_violated = 0
        self._totals = np.zeros(len(self._names))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode, and its score."""
        self.restart_score()
        return self.env.reset(seed=seed, options=options)

    def restart_score(self) -> None:
        """Begins the score and the first objective, as `reset` does, wherever the episode is."""
        self._num_frames = self._num_violated = 0
        self._totals = np.zeros(len(self._names))
        self.objective_scores, self.clauses = [], []
        self.repeat_objective()

    def repeat_objective(self) -> None:
        """Reports the present objective again, after the agent was given another."""
        self._reported_phase = None
        self._report_objective()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Steps the environment and scores each of its control steps."""
        return self.step_schedule([(action, self.substeps_per_decision)])

    def step_schedule(self, schedule: Sequence[tuple[Any, int]]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As `SuiteEnv.step_schedule`, and scores each control step."""
        frame, reward, terminated, truncated, info = self._suite_env.step_schedule(schedule)
        for quantities, frame_reward in zip(info["quantities"], info["rewards"], strict=True):
            self._totals += quantities
            self._score_control_step(dict(zip(self._names, quantities, strict=True)), frame_reward, frame)
        if terminated or truncated:
            self.scores.append(self._episode_score())
        else:
            self._report_objective()
        return frame, reward, terminated, truncated, info

    def summarize(self, episodes: int) -> dict[str, Any]:
        """The scores of the first episodes as plain values for JSON.

        Returns:
            With an objective `objective`, `objective_returns` and their mean `objective_return`; with constraints
            `constraint`, `violation_rates` and their mean `violation_rate`. Always `quantities`: the mean of each true
            quantity over the env frames of all episodes.
        """
        scores = self.scores[:episodes]
        means = {name: float(np.mean([score.quantities[name] for score in scores])) for name in self._names}
        summary: dict[str, Any] = {"quantities": means}
        if self.goals.phases:
            returns = [score.objective_return for score in scores]
            summary |= {"objective": self.goals.objective_text, "objective_return": float(np.mean(returns))}
            summary["objective_returns"] = returns
        if self.goals.constraints:
            rates = [score.violation_rate for score in scores]
            summary |= {"constraint": self.goals.constraint_text, "violation_rate": float(np.mean(rates))}
            summary["violation_rates"] = rates
        return summary

    def _score_control_step(self, values: dict[str, np.float64], reward: float, picture: NDArray[np.uint8]) -> None:
        phase = self._current_phase()
        broken = [not shortfall(clause, values.__getitem__) < 0.0 for clause in self.goals.constraints]
        self._num_violated += any(broken)
        self._num_frames += 1
        shown = [(clause.text, not is_broken) for clause, is_broken in zip(self.goals.constraints, broken, strict=True)]
        if phase is not None:
            terms = phase.objective.terms
            score = sum(weight * self._score_term(term, values, reward, picture) for weight, term in terms)
            if not np.isfinite(score):
                raise UserError(f"the objective gave a score that is not finite: {score}")
            self.objective_scores.append(float(score))
            degrees = [
                (clause.text, float(clause_degree(shortfall(clause, values.__getitem__))))
                for clause in phase.objective.clauses
            ]
            shown = [(text, degree >= MET_DEGREE) for text, degree in degrees] + shown
        self.clauses = shown

    def _score_term(self, term: Any, values: dict[str, np.float64], reward: float, picture: NDArray[np.uint8]) -> float:
        if isinstance(term, LearnedReturn):
            return reward
        if isinstance(term, GoalImage):
            difference = (picture.astype(float) - self._pictures[term.path]) / 255.0
            return float(clause_degree(np.sqrt(np.mean(difference**2)) / PIXEL_MARGIN))
        return float(evaluate(term, values.__getitem__, clause_degree))

    def _current_phase(self) -> Phase | None:
        """The objective at the next env frame; None for the objective of the training."""
        return next((phase for phase in reversed(self.goals.phases) if phase.start <= self._num_frames), None)

    def _report_objective(self) -> None:
        phase = self._current_phase()
        if phase is not self._reported_phase and phase is not None and self._on_objective is not None:
            self._on_objective(phase.objective)
        self._reported_phase = phase

    def _episode_score(self) -> Score:
        means = dict(zip(self._names, (self._totals / self._num_frames).tolist(), strict=True))
        return Score(float(np.sum(self.objective_scores)), self._num_violated / self._num_frames, means)


def score_env(env: SuiteEnv, goals: Goals, planner: Any | None) -> ScoredEnv:
    """The environment with scores; also passes the goals to the planning agent.

    Args:
        env: The environment, which has to report true quantities.
        goals: The goals to score.
        planner: A planning agent, which then pursues the goals; None for an agent that does not plan.

    Raises:
        UserError: The environment does not report true quantities, the agent does not predict a quantity of a goal, or
            a goal image cannot be compared with the frames.
    """
    if planner is None:
        return ScoredEnv(env, goals)
    constraints = goals.constraint_text or ()

    def change(objective: Expression | None) -> None:
        planner.set_objective(objective, constraints)

    for objective in [None, *(phase.objective for phase in goals.phases)]:
        change(objective)  # raises, before an episode is played, if the agent cannot plan for an objective
    return ScoredEnv(env, goals, change)


def _goal_image_paths(objective: Expression) -> list[str]:
    return [term.path for _, term in objective.terms if isinstance(term, GoalImage)]
