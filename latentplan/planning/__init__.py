"""Planning in any model: cross-entropy search, objectives, constraints and receding-horizon control.

The package imports torch and einops, and only the settings from the rest of this project.
"""

from latentplan.config.planner import SearchOptions
from latentplan.planning.adapters import CEMTrajectoryOptimizer
from latentplan.planning.check import check_model
from latentplan.planning.controller import ModelPredictiveController
from latentplan.planning.model import FunctionModel, Model, compile_rollout
from latentplan.planning.objectives import (
    Objective,
    Rollout,
    action_penalty,
    at_every_state,
    conditioned,
    goal_term,
    learned_return,
    rate_limit,
    risk,
    smoothness_penalty,
    terminal_value,
    uncertainty_penalty,
)
from latentplan.planning.plan import Iteration, Plan
from latentplan.planning.realtime.planner import BackgroundPlanner, PlanBuffer
from latentplan.planning.realtime.scheduler import Decision, PlanExecutor, PlanScheduler
from latentplan.planning.realtime.worker import settle
from latentplan.planning.search.cem import CEMPlanner, cem_gradient_planner, icem_planner, mppi_planner
from latentplan.planning.search.elites import refit
from latentplan.planning.search.registry import PLANNERS, Planner, SupportsPlan, make_planner
from latentplan.planning.simulators import JaxModel, MuJoCoModel, Physics

__all__ = [
    "PLANNERS",
    "BackgroundPlanner",
    "CEMPlanner",
    "CEMTrajectoryOptimizer",
    "Decision",
    "FunctionModel",
    "Iteration",
    "JaxModel",
    "Model",
    "ModelPredictiveController",
    "MuJoCoModel",
    "Objective",
    "Physics",
    "Plan",
    "PlanBuffer",
    "PlanExecutor",
    "PlanScheduler",
    "Planner",
    "Rollout",
    "SearchOptions",
    "SupportsPlan",
    "action_penalty",
    "at_every_state",
    "cem_gradient_planner",
    "check_model",
    "compile_rollout",
    "conditioned",
    "goal_term",
    "icem_planner",
    "learned_return",
    "make_planner",
    "mppi_planner",
    "rate_limit",
    "refit",
    "risk",
    "settle",
    "smoothness_penalty",
    "terminal_value",
    "uncertainty_penalty",
]
