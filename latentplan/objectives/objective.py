"""What a search maximises for an expression, and keeps for a constraint, by the quantities that a model predicts.

The model has `label_names`, states with `features` (rows, feature), and `probe(features)`, the predicted quantities.
What is planned for differs from what is scored in two points, both because a prediction is not the truth: degrees
fall off more slowly, so that a clause far from holding still tells the search where to go, and inequalities that must
hold are kept with some distance.
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
from latentplan.objectives.box import BoxView, Interval, box_of, plan_degree
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

CAUTION = 0.1  # margins that a plan stays away from where a constraint would break
GUIDANCE = 0.25  # what the end of a plan counts, of what the plan would earn at the learned rate of reward
GOAL_DISTANCE = 1.0  # root mean square distance of latents that counts as one margin


def plan_goals(
    objective: str | Expression | Term | None,
    constraints: str | Sequence[Constraint],
    *,
    model: Any,
    env: EnvConfig,
    planner: Planner,
    encode_goal: Callable[[str], Tensor],
) -> tuple[Term | None, Sequence[Constraint]]:
    """What a planner is given for goals written as text.

    Args:
        objective: A text or what the parser made of it; a term, or None for what the agent was trained for, stays.
        constraints: Inequalities separated by `;`; functions of imagined rollouts stay.
        model: The world model, with `labels` and `label_names`.
        env: Settings of the environment.
        planner: Who searches: its horizon for goals, its discount, and whether rollouts have a value at their end.
        encode_goal: See `plan_objective`.

    Raises:
        UserError: A text is no expression, or is about what this agent does not predict.
    """
    known = model.labels or scales(env.domain)
    if objective is not None and not isinstance(objective, str | Expression) and not callable(objective):
        raise UserError(f"an objective is an expression or a function of rollouts, got {objective!r}")
    if not isinstance(constraints, str) and any(isinstance(constraint, str) for constraint in constraints):
        raise UserError("constraints are one text, inequalities separated by ';', or functions of rollouts")
    if isinstance(objective, str):
        objective = parse_objective(objective, known)
    if isinstance(objective, Expression):
        require_labels([node for _, node in objective.terms], model.label_names)
        wanted, learned = objective, predicted_return(model, planner.terminal_value)
        has_value = supports(model, "value") if planner.terminal_value is None else planner.terminal_value
        # A value of v is a reward of v (1 - discount) in every step there will ever be; the plan has `horizon` of them.
        horizon = planner.goal_horizon or planner.horizon
        guide = GUIDANCE * horizon * (1.0 - planner.discount) * terminal_value() if has_value else None
        box = learned_box(wanted, model) if has_value else None
        if box is not None:
            objective = conditioned(BoxView(box, env.action_repeat))
        elif wanted.is_return:
            objective = None
        else:
            objective = plan_objective(wanted, env.action_repeat, learned, guide, encode_goal)
    if isinstance(constraints, str):
        clauses = parse_constraints(constraints, known)
        require_labels(clauses, model.label_names)
        constraints = [plan_constraint(clauses)]
    return objective, constraints


def learned_box(expression: Expression, model: Any) -> dict[str, Interval] | None:
    """The box that an expression asks for, if it is one and the model has learned to pursue boxes."""
    return box_of(expression, model.goal_names) if getattr(model, "goal_dim", 0) else None


def plan_objective(
    expression: Expression,
    frames_per_step: int,
    learned: Objective,
    guide: Objective | None,
    encode_goal: Callable[[str], Tensor],
) -> Objective:
    """The predicted worth of an expression, summed over the env frames of each imagined rollout with its weights.

    Nothing tells what an expression is worth beyond the rollout. Where a body can do what it was trained for, though,
    it has not fallen, and can do most other things as well: a guide of little weight tells those ends from others.

    Args:
        expression: What to maximise.
        frames_per_step: Env frames that one imagined step stands for.
        learned: What `return` stands for.
        guide: Added once where the expression holds no `return`.
        encode_goal: Gives the latent (latent,) of a picture's path, or one for each turn that beliefs have (turn,
            latent); called once per goal.
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
        objectives.append(Objective(partial(_worth, tuple(quantities)), needs_states=True, needs=needs))
    return sum(objectives[1:], objectives[0])


def plan_constraint(clauses: Sequence[Clause]) -> Objective:
    """By how many margins predicted quantities break the clauses, summed over steps; 0 where all hold with distance."""
    return Objective(partial(_violation, tuple(clauses)), needs_states=True, needs=("probe",))


def require_labels(nodes: Sequence[Node], labels: Sequence[str]) -> None:
    """Refuses expressions about quantities that a model does not predict.

    Raises:
        UserError: Names the first such quantity.
    """
    for name in [part.name for node in nodes for part in walk(node) if isinstance(part, Name)]:
        if name not in labels:
            known = f"it predicts {', '.join(labels)}" if labels else "it was trained without named quantities"
            raise UserError(f"this agent cannot plan for {name!r}: {known}")


def predicted_quantities(rollout: Rollout) -> Lookup:
    """The quantities predicted after every imagined step; each is (step, rows), float32.

    Returns:
        A function from a quantity's name to its values.
    """

    @cache
    def labels() -> Tensor:  # once there is something to look up: not every model has a probe
        features = torch.stack([state.features for state in rollout.states])
        flat = rollout.model.probe(rearrange(features, "step rows feature -> (step rows) feature")).float()
        return rearrange(flat, "(step rows) label -> label step rows", step=len(features))

    return lambda name: labels()[list(rollout.model.label_names).index(name)]


def _violation(clauses: Sequence[Clause], rollout: Rollout) -> Tensor:
    values = predicted_quantities(rollout)
    excesses = [torch.as_tensor(shortfall(clause, values)) + CAUTION for clause in clauses]
    return reduce(torch.stack(excesses).clamp_min(0.0), "clause step rows -> rows", "sum")


def _worth(terms: Sequence[tuple[float, Node]], rollout: Rollout) -> Tensor:
    values = predicted_quantities(rollout)
    worth: Any = sum(weight * evaluate(node, values, plan_degree) for weight, node in terms)
    return _discounted(torch.as_tensor(worth).expand(len(rollout.states), len(rollout.actions)), rollout)


def _closeness(goal: Tensor, rollout: Rollout) -> Tensor:
    latents, particles = torch.stack([state.stoch for state in rollout.states]).float(), rollout.num_particles
    turns = torch.atleast_2d(goal.float())
    order = torch.arange(particles, device=goal.device) % len(turns)
    targets = repeat(turns[order], "particle latent -> (row particle) latent", row=len(rollout.actions) // particles)
    distances = (latents - targets).square().mean(dim=-1).sqrt()
    return _discounted(plan_degree(distances / GOAL_DISTANCE), rollout)


def _discounted(worth: Tensor, rollout: Rollout) -> Tensor:
    """The worth of states (step, rows) weighted and summed, (rows,)."""
    by_row = rearrange(worth, "step rows -> rows step").to(rollout.rewards.dtype)
    return (by_row * rollout.weights[..., :-1]).sum(dim=1)
