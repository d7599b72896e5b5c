"""Objectives and constraints of the planner, made from expressions over quantities that the world model predicts.

The model has `label_names`, states with `features` (rows, feature), and `probe(features)`, the predicted quantities.
Planning differs from scoring in two points: degrees fall more slowly, so that a search far from the goal still
makes progress, and a plan keeps a distance from the limit of each constraint, because predictions have errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import torch
from einops import rearrange, reduce, repeat
from torch import Tensor

from latentplan.config import EnvConfig, UserError
from latentplan.config.quantities import scales
from latentplan.objectives.box import BoxView, box_of, planning_degree
from latentplan.objectives.expression import (
    Clause,
    Expression,
    GoalImage,
    LearnedReturn,
    Lookup,
    Name,
    Node,
    evaluate,
    shortfall,
    walk,
)
from latentplan.objectives.parser import parse_constraints, parse_objective
from latentplan.planning.model import supports
from latentplan.planning.objectives import (
    Constraint,
    Objective,
    Rollout,
    Term,
    conditioned,
    predicted_return,
    terminal_value,
)
from latentplan.planning.search.registry import Planner

CONSTRAINT_DISTANCE = 0.1  # distance that a plan keeps from the limit of a constraint, in margins
GUIDE_WEIGHT = 0.25  # of the guide: 1 would add the reward rate of the terminal value at every step of the plan
GOAL_DISTANCE = 1.0  # root mean square distance of latents that counts as one margin


def build_goals(
    objective: str | Expression | Term | None,
    constraints: str | Sequence[Constraint],
    *,
    model: Any,
    env: EnvConfig,
    planner: Planner,
    encode_goal: Callable[[str], Tensor],
) -> tuple[Term | None, Sequence[Constraint]]:
    """Builds the planner's objective and constraints from text.

    Args:
        objective: Text, or a parsed expression. A function of rollouts, or None for the objective of the training, is
            returned unchanged.
        constraints: Inequalities separated by `;`; blank text sets no constraint. Functions of rollouts are returned
            unchanged.
        model: The world model, with `labels` and `label_names`.
        env: Settings of the environment.
        planner: The planner; its horizon, its discount and its use of the terminal value set the weight of the guide.
        encode_goal: See `build_objective`.

    Raises:
        UserError: A text is not an expression, or names a quantity that this model does not predict; or an argument is
            something else than text and functions.
    """
    known = model.labels or scales(env.domain)
    if objective is not None and not isinstance(objective, str | Expression) and not callable(objective):
        raise UserError(f"an objective must be an expression or a function of rollouts, got {objective!r}")
    is_list = isinstance(constraints, Sequence) and all(map(callable, constraints))
    if not isinstance(constraints, str) and not is_list:
        raise UserError(
            "constraints must be one text, with inequalities separated by ';', or a list of functions of rollouts"
        )
    if isinstance(objective, str):
        objective = parse_objective(objective, known)
    if isinstance(objective, Expression):
        objective = _build_expression(objective, model, env, planner, encode_goal)
    if isinstance(constraints, str):
        clauses = parse_constraints(constraints, known)
        require_labels(clauses, model.label_names)
        constraints = [build_constraint(clauses)] if clauses else ()
    return objective, constraints


def build_objective(
    expression: Expression,
    frames_per_step: int,
    learned: Objective,
    guide: Objective | None,
    encode_goal: Callable[[str], Tensor],
) -> Objective:
    """Builds the predicted score of an expression, summed over the env frames of a rollout with the rollout's weights.

    The model has no terminal value for an expression. The guide replaces the terminal value: from states with a high
    value for the training task, in which the body has not fallen, most other tasks are possible too.

    Args:
        expression: Expression to maximise.
        frames_per_step: Env frames per model step.
        learned: The objective for `return`.
        guide: Added once if the expression does not contain `return`; None adds nothing.
        encode_goal: Returns the latent (latent,) of the image at a path, or one latent per orientation of the beliefs
            (turn, latent); called once per goal image.
    """
    objectives: list[Objective] = []
    quantities: list[tuple[float, Node]] = []
    for weight, term in expression.terms:
        if isinstance(term, LearnedReturn):
            objectives.append(weight * learned)
        elif isinstance(term, GoalImage):
            closeness = Objective(partial(_closeness, encode_goal(term.path)), needs_states=True)
            objectives.append(weight * frames_per_step * closeness)
        else:
            quantities.append((weight * frames_per_step, term))
    if guide is not None and not any(isinstance(term, LearnedReturn) for _, term in expression.terms):
        objectives.append(guide)
    if quantities:
        needs = ("probe",) if expression.names else ()
        objectives.append(Objective(partial(_score, tuple(quantities)), needs_states=True, needs=needs))
    return sum(objectives[1:], objectives[0])


def build_constraint(clauses: Sequence[Clause]) -> Objective:
    """Builds the predicted violation of clauses in margins, summed over steps.

    The violation is 0 if all clauses hold by at least `CONSTRAINT_DISTANCE` at every step.
    """
    return Objective(partial(_violation, tuple(clauses)), needs_states=True, needs=("probe",))


def require_labels(nodes: Sequence[Node], labels: Sequence[str]) -> None:
    """Checks that a model predicts all quantities of expressions.

    Args:
        nodes: The expressions.
        labels: Names of the quantities that the model predicts.

    Raises:
        UserError: A quantity is not among the labels; the message names the first such quantity.
    """
    for name in [part.name for node in nodes for part in walk(node) if isinstance(part, Name)]:
        if name not in labels:
            known = f"it predicts {', '.join(labels)}" if labels else "it was trained without named quantities"
            raise UserError(f"this agent cannot plan for {name!r}: {known}")


def predicted_quantities(rollout: Rollout) -> Lookup:
    """A function from the name of a quantity to its predicted values after every step, (step, rows), float32."""

    @cache
    def labels() -> Tensor:  # called at the first look-up only, because not every model has a probe
        features = torch.stack([state.features for state in rollout.states])
        flat = rollout.model.probe(rearrange(features, "step rows feature -> (step rows) feature")).float()
        return rearrange(flat, "(step rows) label -> label step rows", step=len(features))

    return lambda name: labels()[list(rollout.model.label_names).index(name)]


def _build_expression(
    expression: Expression, model: Any, env: EnvConfig, planner: Planner, encode_goal: Callable[[str], Tensor]
) -> Term | None:
    """The planner's objective for an expression; None if the expression is the learned return."""
    require_labels([node for _, node in expression.terms], model.label_names)
    has_value = supports(model, "value") if planner.terminal_value is None else planner.terminal_value
    has_goal_heads = bool(getattr(model, "goal_dim", 0))
    box = box_of(expression, model.goal_names) if has_value and has_goal_heads else None
    if box is not None:
        return conditioned(BoxView(box, env.action_repeat))
    if expression.is_return:
        return None
    # A value of v stands for a reward of v (1 - discount) in every future step; the plan has `horizon` steps.
    horizon = planner.goal_horizon or planner.horizon
    guide = GUIDE_WEIGHT * horizon * (1.0 - planner.discount) * terminal_value() if has_value else None
    learned = predicted_return(model, planner.terminal_value)
    return build_objective(expression, env.action_repeat, learned, guide, encode_goal)


def _violation(clauses: Sequence[Clause], rollout: Rollout) -> Tensor:
    values, device = predicted_quantities(rollout), rollout.rewards.device
    excesses = [torch.as_tensor(shortfall(clause, values), device=device) + CONSTRAINT_DISTANCE for clause in clauses]
    return reduce(torch.stack(excesses).clamp_min(0.0), "clause step rows -> rows", "sum")


def _score(terms: Sequence[tuple[float, Node]], rollout: Rollout) -> Tensor:
    values = predicted_quantities(rollout)
    score: Any = sum(weight * evaluate(node, values, planning_degree) for weight, node in terms)
    score = torch.as_tensor(score, device=rollout.rewards.device)
    return _discounted(score.expand(len(rollout.states), len(rollout.actions)), rollout)


def _closeness(goal: Tensor, rollout: Rollout) -> Tensor:
    latents, particles = torch.stack([state.stoch for state in rollout.states]).float(), rollout.num_particles
    turns = torch.atleast_2d(goal.float())
    order = torch.arange(particles, device=goal.device) % len(turns)
    targets = repeat(turns[order], "particle latent -> (row particle) latent", row=len(rollout.actions) // particles)
    distances = (latents - targets).square().mean(dim=-1).sqrt()
    return _discounted(planning_degree(distances / GOAL_DISTANCE), rollout)


def _discounted(scores: Tensor, rollout: Rollout) -> Tensor:
    """Scores of states (step, rows), weighted and summed, (rows,)."""
    by_row = rearrange(scores, "step rows -> rows step").to(rollout.rewards.dtype)
    return (by_row * rollout.weights[..., :-1]).sum(dim=1)
